"""`terrafix log export`: a flight in the formats of other programs."""
