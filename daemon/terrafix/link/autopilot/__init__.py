"""The served autopilot and its state."""
