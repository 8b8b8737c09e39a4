"""Monitors of what the flight was described as: scale, mount, heading, attitude, registration."""
