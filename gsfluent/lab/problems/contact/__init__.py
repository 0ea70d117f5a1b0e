"""Contact problems with known answers."""
