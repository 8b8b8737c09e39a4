"""The MAVLink connection: transport, framing, signing, message rates, time synchronisation."""
