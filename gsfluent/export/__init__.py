"""A finished simulation in other programs' formats."""
