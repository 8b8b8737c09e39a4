"""Encoders of the position for each protocol, and the schedule of transmissions."""
