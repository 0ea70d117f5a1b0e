"""What a photograph of a cut says: exemplar, mask, light, stains, parts."""
