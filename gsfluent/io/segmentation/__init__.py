"""Label maps of photographs, read from any segmenter's files."""
