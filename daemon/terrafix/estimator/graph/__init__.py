"""Factor graph: the iSAM2 window, and the linear system of what has left it."""
