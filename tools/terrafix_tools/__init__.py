"""What stays on the ground."""

import terrafix  # noqa: F401 (before numpy, which a tool may import first: see there)
