"""Programs of the ground station: map building, simulation, evaluation and pre-flight checks."""

import terrafix  # noqa: F401 - imported before numpy, which a tool may import first: see terrafix/__init__.py
