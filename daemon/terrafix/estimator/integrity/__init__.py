"""Fault detection: innovation gates, alternative positions, time offset, unobservable yaw. None changes the graph."""
