"""`terrafix log`: what is in a flight record, as text and in the formats of other programs."""
