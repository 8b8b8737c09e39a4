"""Which estimate is sent, as which fix, and carried to when."""
