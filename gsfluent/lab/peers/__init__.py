"""What was measured of other programs."""
