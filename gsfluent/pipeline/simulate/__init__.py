"""Scene -> frames: stage, run, step, health; the engines; what is off the grid."""
