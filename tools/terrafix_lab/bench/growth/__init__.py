"""Costs that grow with the flight or the map."""
