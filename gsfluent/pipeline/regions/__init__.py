"""Labels of photographs -> parts of a solid."""
