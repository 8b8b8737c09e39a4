"""Monitors of the configured description of a flight: scale, mount, heading, attitude, registration with the map."""
