"""Gaussians -> picture -> video; the Render stage."""
