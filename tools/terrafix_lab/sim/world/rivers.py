"""Rivers and hills of the generated country, as functions of position and seed, so that any part can be computed
alone.
"""

import functools
import math

import numpy as np

from terrafix_lab.sim.world.noise import smooth

FIRST_RIVER_M, NEXT_RIVER_M, WANDER_M = 1000.0, 4000.0, 400.0  # rivers run from west to east, below each other
MEANDERS_M = ((1400.0, 120.0), (520.0, 45.0), (230.0, 16.0))  # length, size
REACH_M = 250.0  # of a river from its centre line: all meanders and half a lake
LAKES_M = 2600.0  # distance between lakes
LAKE_WIDTH_M, LAKE_LENGTH_M = 105.0, 95.0
STEP_M = 14.0  # spacing of points along a river, at multiples of this, so that neighbouring windows have the same water
POST_M = 10.0  # post spacing of the elevation model
GROUND_AMSL_M = 320.0
RELIEF_M = 34.0  # from the river to the hills
VALLEY_M = 620.0  # half width of a valley: slopes of a few per cent, as in farmland
HILLS_POSTS = ((38.0, 1.0), (14.0, 0.25))  # size (1-sigma), weight of hills and hillocks


def rivers(seed: int, x0_m: float, y0_m: float, x1_m: float, y1_m: float) -> list[np.ndarray]:
    """Returns the rivers that touch a box, each (N, 3): x, y, width; from west to east, extended beyond the box."""
    s = np.arange(math.floor(x0_m / STEP_M) - 12, math.ceil(x1_m / STEP_M) + 13) * STEP_M
    first = math.floor((y0_m - FIRST_RIVER_M - REACH_M - WANDER_M) / NEXT_RIVER_M)
    last = math.ceil((y1_m - FIRST_RIVER_M + REACH_M + WANDER_M) / NEXT_RIVER_M)
    found = [np.stack([s, _centre_line(seed, k, s), _width(seed, k, s)], axis=1) for k in range(first, last + 1)]
    return [r for r in found if r[:, 1].max() > y0_m - REACH_M and r[:, 1].min() < y1_m + REACH_M]


def from_bank_m(river: np.ndarray, point: tuple[float, float]) -> float:
    """Distance from the bank, m; negative in the water."""
    return float((np.hypot(river[:, 0] - point[0], river[:, 1] - point[1]) - river[:, 2] / 2).min())


def elevation(seed: int, column: int, row: int, width: int, height: int) -> np.ndarray:
    """Returns posts (height, width) float32, metres AMSL, from plan metres (column, row) x POST_M on."""
    at = (column, row, width, height)
    hills = np.sum([w * smooth(seed + 101 + n, size, *at) for n, (size, w) in enumerate(HILLS_POSTS)], axis=0)
    x, y = np.arange(column, column + width) * POST_M, np.arange(row, row + height) * POST_M
    first = math.floor((y[0] - FIRST_RIVER_M) / NEXT_RIVER_M) - 1
    distance_m = np.full((height, width), np.inf)
    for k in range(first, first + math.ceil((y[-1] - y[0]) / NEXT_RIVER_M) + 4):
        centre_line = _centre_line(seed, k, x)
        slope_factor = np.sqrt(1.0 + np.gradient(centre_line, POST_M) ** 2) if width > 1 else np.ones(1)
        distance_m = np.minimum(distance_m, np.abs(y[:, None] - centre_line[None, :]) / slope_factor[None, :])
    valley = 1.0 - np.exp(-((distance_m / VALLEY_M) ** 2))
    return (GROUND_AMSL_M + RELIEF_M * (valley * (0.75 + 0.15 * hills) + 0.08 * hills)).astype(np.float32)


@functools.lru_cache(maxsize=256)
def _shape(seed: int, k: int) -> tuple[float, np.ndarray]:
    """Returns the y of the centre line of river ``k``, and the phases of its meanders."""
    rng = np.random.default_rng([seed, 2, k % 2**32])
    return FIRST_RIVER_M + k * NEXT_RIVER_M + rng.uniform(-WANDER_M, WANDER_M), rng.uniform(0.0, 2 * math.pi, 3)


def _centre_line(seed: int, k: int, x_m: np.ndarray) -> np.ndarray:
    y_m, phases = _shape(seed, k)
    waves = [
        size * np.sin(2 * math.pi * x_m / length + p) for (length, size), p in zip(MEANDERS_M, phases, strict=True)
    ]
    return y_m + np.sum(waves, axis=0)


def _width(seed: int, k: int, x_m: np.ndarray) -> np.ndarray:
    width = 13.0 + 4.0 * np.sin(x_m / 90.0)
    for lake in range(math.floor(x_m[0] / LAKES_M) - 1, math.ceil(x_m[-1] / LAKES_M) + 1):
        rng = np.random.default_rng([seed, 3, k % 2**32, lake % 2**32])
        at_m = (lake + rng.uniform(0.25, 0.75)) * LAKES_M
        width = width + LAKE_WIDTH_M * np.exp(-(((x_m - at_m) / LAKE_LENGTH_M) ** 2))
    return width
