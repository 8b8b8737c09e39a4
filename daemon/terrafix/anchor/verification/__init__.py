"""Whether a place is right: evidence of patches, and of looks in a row."""
