"""Verification of a position: evidence of patches in one frame, and over frames."""
