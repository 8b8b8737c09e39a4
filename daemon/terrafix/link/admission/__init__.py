"""Decides which packets on the autopilot's link are accepted, and from which sender."""
