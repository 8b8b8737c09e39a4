"""Descriptors of ground for place recognition."""
