"""Positions of a recording at the times of its frames: truth for an evaluation, which no flight reads."""

from collections.abc import Iterable, Sequence

import numpy as np

MAX_FIX_GAP_NS = 2_000_000_000  # between two fixes that are farther apart no position is interpolated

Fix = tuple[int, float, float]  # time [ns], latitude, longitude [degrees]


def positions_at(frames: Iterable[tuple[str, int]], fixes: Sequence[Fix]) -> list[tuple[str, float, float]]:
    """``frames``: file and time [ns]. -> (file, latitude, longitude) of those between two fixes."""
    table = np.array(sorted(fixes), dtype=np.float64).reshape(-1, 3)
    found = []
    for file, t_ns in frames:
        after = int(np.searchsorted(table[:, 0], t_ns))
        if 0 < after < len(table) and table[after, 0] - table[after - 1, 0] <= MAX_FIX_GAP_NS:
            lat_deg, lon_deg = (float(np.interp(t_ns, table[:, 0], table[:, axis])) for axis in (1, 2))
            found.append((file, lat_deg, lon_deg))
    return found
