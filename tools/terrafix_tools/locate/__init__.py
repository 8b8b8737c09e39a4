"""`terrafix locate`: the position of what a pixel of a frame shows."""
