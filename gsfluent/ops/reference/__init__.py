"""The definition of each operator in plain PyTorch: readable, slow, float64 capable."""
