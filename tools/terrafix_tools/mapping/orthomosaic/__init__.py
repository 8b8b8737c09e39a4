"""`terrafix map mosaic`: the frames of a flight as a newer layer of the map."""
