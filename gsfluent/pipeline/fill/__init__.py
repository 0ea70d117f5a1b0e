"""Gaussians inside a solid; the Fill stage."""
