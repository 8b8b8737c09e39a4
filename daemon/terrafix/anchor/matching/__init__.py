"""Matching of one frame with the map."""
