"""Lamps, shadow maps, shading, occlusion, baking."""
