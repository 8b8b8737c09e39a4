"""The autopilot that is served, and its state."""
