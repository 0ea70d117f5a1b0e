"""How the viewer makes its pictures."""
