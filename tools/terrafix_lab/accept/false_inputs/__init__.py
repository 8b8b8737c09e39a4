"""Scenarios with a false input."""
