"""gsfluent's answers to FractureBench."""
