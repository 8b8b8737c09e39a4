"""Search for an unknown position on the map."""
