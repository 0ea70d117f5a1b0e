"""Splats in files: PLY, compressed PLY, .splat, SPZ, delta sequences."""
