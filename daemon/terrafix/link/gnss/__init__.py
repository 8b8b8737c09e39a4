"""GNSS receivers of the autopilot: spoofing detection, and the map offset that a trusted receiver shows."""
