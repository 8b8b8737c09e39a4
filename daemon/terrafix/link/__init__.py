"""The link process: MAVLink to and from the autopilot. Output is GPS_INPUT at 10 Hz; see docs/link.md."""
