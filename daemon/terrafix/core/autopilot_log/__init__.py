"""Logs that an autopilot writes itself, and their clock against that of a flight."""
