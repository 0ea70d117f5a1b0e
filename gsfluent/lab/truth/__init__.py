"""Objects whose inside, light and pictures are known."""
