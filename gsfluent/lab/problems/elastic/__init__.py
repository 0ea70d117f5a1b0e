"""Elastic problems with known answers."""
