"""Faults that a scenario adds to a flight."""
