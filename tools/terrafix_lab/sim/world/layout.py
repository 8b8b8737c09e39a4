"""A generated place: a part of the generated country with its elevation model."""

from dataclasses import dataclass

import numpy as np

from terrafix_lab.sim.world.rivers import POST_M, elevation

DEM_POST_M = POST_M
DEM_MARGIN_M = 300.0  # the DEM extends beyond the image, like real ones


@dataclass(frozen=True)
class Layout:
    """Plan metres are relative to the upper left corner of the place, which is that of the country's cell (0, 0)."""

    seed: int
    width_m: float
    height_m: float
    dem_amsl_m: np.ndarray  # (h, w) float32, posts every DEM_POST_M from (-DEM_MARGIN_M, -DEM_MARGIN_M)


def plan(seed: int, width_m: float, height_m: float) -> Layout:
    """Returns the place of that size; a larger one with the same seed contains it."""
    margin = round(DEM_MARGIN_M / DEM_POST_M)
    columns, rows = int(width_m / DEM_POST_M) + 2 * margin + 1, int(height_m / DEM_POST_M) + 2 * margin + 1
    return Layout(seed, width_m, height_m, elevation(seed, -margin, -margin, columns, rows))
