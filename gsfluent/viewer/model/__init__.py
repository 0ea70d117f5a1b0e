"""What the viewer knows: sources of frames, the time line, what is looked at."""
