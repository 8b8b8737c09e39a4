"""The map package: a library of its own, read by the anchor and by the tools."""
