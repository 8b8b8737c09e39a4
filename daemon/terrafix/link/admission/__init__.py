"""Whose packets are heard, and which are believed."""
