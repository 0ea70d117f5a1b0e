"""Rigid things and blades while they move."""
