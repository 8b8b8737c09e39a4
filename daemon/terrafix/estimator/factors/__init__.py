"""Factors of the graph."""
