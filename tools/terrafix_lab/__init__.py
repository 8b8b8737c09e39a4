"""The lab: what simulates, judges and trains. Imports what flies and the operator's commands; neither imports it."""

import terrafix  # noqa: F401 - imported before numpy, which a tool may import first: see terrafix/__init__.py
