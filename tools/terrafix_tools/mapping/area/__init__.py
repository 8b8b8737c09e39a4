"""The area of a map: polygons, files, checks."""
