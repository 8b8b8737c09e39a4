"""MAVLink message fields in SI units, for the live link and for recorded logs."""
