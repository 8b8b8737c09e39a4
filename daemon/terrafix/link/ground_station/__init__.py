"""Own links to ground stations, the ghost vehicle, and position hints from operators."""
