"""Liquids, sand and metal with known answers."""
