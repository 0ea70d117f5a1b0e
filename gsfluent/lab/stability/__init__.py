"""Maps of where a run first breaks a law."""
