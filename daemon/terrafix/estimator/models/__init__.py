"""Motion, terrain and lens: no measurement and no graph."""
