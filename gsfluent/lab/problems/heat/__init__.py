"""Heat: conduction and melting with known answers."""
