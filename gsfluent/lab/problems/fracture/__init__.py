"""Fracture problems with known answers."""
