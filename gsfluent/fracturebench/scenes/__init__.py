"""The scenes: loads, materials, judges."""
