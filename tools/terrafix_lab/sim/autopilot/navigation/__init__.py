"""Navigation of the simulated autopilot: GPS library, selection of a receiver, filter and its status."""
