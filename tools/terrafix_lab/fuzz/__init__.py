"""Fuzzing of the parsers of everything that comes from outside."""
