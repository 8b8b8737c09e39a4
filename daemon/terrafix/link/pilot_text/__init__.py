"""Texts for the pilot: STATUSTEXT messages and the debounce that limits their rate."""
