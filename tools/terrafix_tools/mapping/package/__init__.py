"""Parts of a map package as they are written."""
