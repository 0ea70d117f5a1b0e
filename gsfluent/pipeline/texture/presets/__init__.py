"""Insides that are drawn by rule."""
