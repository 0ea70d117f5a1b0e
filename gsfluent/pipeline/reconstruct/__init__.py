"""Photographs -> Gaussians; the object apart from its background."""
