"""GNSS receivers: whether to trust them, and the map error that a trusted one shows."""
