"""What an operator runs: maps, flights and their records, the vehicle, the console."""

import terrafix  # noqa: F401 - imported before numpy, which a tool may import first: see terrafix/__init__.py
