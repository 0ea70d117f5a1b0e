"""The definition of each operator in plain PyTorch, readable and slow; float64 unless the caller says otherwise."""
