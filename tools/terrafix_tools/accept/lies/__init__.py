"""Scenarios in which an input lies."""
