"""The iSAM2 window, and what has left it."""
