"""Ground stations."""
