"""Index over place descriptors of one or several map packages, for maps too large to be correlated as a whole."""
