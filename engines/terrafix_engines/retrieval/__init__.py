"""Descriptors for place recognition."""
