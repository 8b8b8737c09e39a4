"""The search for a place that is not known."""
