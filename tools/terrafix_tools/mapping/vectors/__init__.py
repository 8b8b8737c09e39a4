"""Vector features of a map, from OpenStreetMap."""
