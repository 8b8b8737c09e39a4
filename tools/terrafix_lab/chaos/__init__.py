"""Fault matrix: each fault in each phase of a flight, with the real processes, and what came of it."""
