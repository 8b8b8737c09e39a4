"""Downloads for map sources."""
