"""`terrafix files`: configuration, parameters and units that come with Terrafix."""
