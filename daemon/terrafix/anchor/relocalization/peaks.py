"""The best places of a correlation over the map: local maxima, and the best value beside each."""

from dataclasses import dataclass

import numpy as np

UNKNOWN = -9.0  # value in standard deviations where the map does not cover the frames [spec: below any correlation]


@dataclass(frozen=True)
class Peak:
    """A local maximum: cell, and its value in standard deviations."""

    row: int
    column: int
    z: float


def find_peaks(z: np.ndarray, count: int, near: int, beside_count: int, same: int) -> tuple[list[Peak], list[Peak]]:
    """The ``count`` best cells of ``z`` (H, W), no two of them within ``near`` cells, best first; and for the first
    ``beside_count`` of these the best cell within ``near`` cells that is more than ``same`` cells away."""
    remaining, peaks, beside = z.copy(), list[Peak](), list[Peak]()
    for k in range(count):
        peaks.append(_best_of(remaining, 0, 0))
        r, c = peaks[-1].row, peaks[-1].column
        r0, c0 = max(r - near, 0), max(c - near, 0)
        if k < beside_count:
            remaining[max(r - same, 0) : r + same + 1, max(c - same, 0) : c + same + 1] = UNKNOWN
            beside.append(_best_of(remaining[r0 : r + near + 1, c0 : c + near + 1], r0, c0))
        remaining[r0 : r + near + 1, c0 : c + near + 1] = UNKNOWN
    return peaks, beside


def _best_of(region: np.ndarray, r0: int, c0: int) -> Peak:
    """``r0``, ``c0``: cell of the first value of the region."""
    r, c = (int(v) for v in np.unravel_index(int(np.argmax(region)), region.shape))
    return Peak(r0 + r, c0 + c, float(region[r, c]))
