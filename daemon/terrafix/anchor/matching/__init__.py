"""One frame against the map."""
