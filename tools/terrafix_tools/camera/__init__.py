"""`terrafix camera`: descriptions of cameras, from calibrations of others, from images of a board, from answers."""
