"""Monitors of what a flight is described by: height, focal length, mount, mirrored pictures. Pure; no graph."""
