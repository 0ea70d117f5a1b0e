"""Neighbours, voxels, densities, distances, winding numbers."""
