"""The textbook solver: MPM as papers print it, with its variants."""
