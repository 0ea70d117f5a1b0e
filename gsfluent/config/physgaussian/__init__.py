"""PhysGaussian's model folders and JSON configs."""
