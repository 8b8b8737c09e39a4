"""How a time offset changes: probability mass (R, L) over rates and offsets, moved on in time."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.gate import MIN_COMPONENT_WEIGHT
from terrafix.messages import STAMP_SIGMA_S

STEP_S = 0.05  # s: of the grid of offsets [tuned]
# s: two seconds early (late telemetry), three late: what the camera source lets pass [spec: vision/sources/camera.py]
DRIFT_GRID_S = np.arange(-2.0, 3.0001, STEP_S)
# Probabilities of the offset of an empty buffer. [spec: STAMP_SIGMA_S]
EMPTY_BUFFER = np.exp(-0.5 * (DRIFT_GRID_S / STAMP_SIGMA_S) ** 2)
EMPTY_BUFFER /= EMPTY_BUFFER.sum()
RESOLUTION_S2 = STEP_S**2 / 12.0  # s^2 [spec: variance of a uniform density over a grid cell]
# s/s at which an offset may drift; 0 first. A buffer fills by what a receiver is slower: 2 to 40 %, and empties again.
RATES = np.array([0.0, -0.4, -0.1, 0.02, 0.05, 0.1, 0.2, 0.4])  # [spec: the last one fills the grid in 8 s]
# Of an offset that jumps the share that becomes that of an empty buffer: a stream that is opened again, or catches up.
FLUSHED_SHARE = 0.5  # [spec: a fault ends as often as one begins]
STOP_HZ = 1.0 / 20.0  # a drift ends after 20 s in the mean: a buffer is full [spec: half of 2 s in 40 s]
# Share of the repeats after which a stream is as much later: one that repeats a picture to fill a gap goes on live.
HELD_SHARE = 2.0 * MIN_COMPONENT_WEIGHT  # [spec: the claim contains it at once]


@dataclass(frozen=True)
class Hazards:
    """Per second: that a constant offset begins to drift, that it jumps to any other."""

    drift_hz: float
    jump_hz: float


def predicted(mass: np.ndarray, dt_s: float, hazards: Hazards) -> np.ndarray:
    """``mass`` (R, L) after ``dt_s``."""
    if dt_s <= 0.0:
        return mass
    moved = np.array([_shifted(row, rate * dt_s / STEP_S) for row, rate in zip(mass, RATES, strict=True)])
    after = transitions(dt_s, hazards).T @ moved
    jump = _chance(hazards.jump_hz, dt_s)
    anywhere = FLUSHED_SHARE * EMPTY_BUFFER + (1.0 - FLUSHED_SHARE) / len(DRIFT_GRID_S)
    after += jump * (np.outer(np.arange(len(RATES)) == 0, float(after.sum()) * anywhere) - after)
    return np.asarray(after)


def held(mass: np.ndarray, held_s: float) -> np.ndarray:
    """``mass`` (R, L) after a stream has repeated pictures for ``held_s``: they may lie in its buffer since, or others
    of before."""
    later = np.array([_shifted(row, held_s / STEP_S) for row in mass])
    later[0] = 0.5 * (later[0] + float(later[0].sum()) / len(DRIFT_GRID_S))
    return np.asarray((1.0 - HELD_SHARE) * mass + HELD_SHARE * later)


def transitions(dt_s: float, hazards: Hazards) -> np.ndarray:
    """(R, R): probability of the rate of the column ``dt_s`` after that of the row."""
    drift, stop = _chance(hazards.drift_hz, dt_s), _chance(STOP_HZ, dt_s)
    matrix = (1.0 - stop) * np.eye(len(RATES))
    matrix[0], matrix[1:, 0], matrix[0, 0] = drift / (len(RATES) - 1), stop, 1.0 - drift
    return matrix


def _chance(hz: float, dt_s: float) -> float:
    return 1.0 - float(np.exp(-hz * dt_s))


def _shifted(row: np.ndarray, cells: float) -> np.ndarray:
    """``row`` (L,) moved by ``cells``; what leaves the grid stays at its end."""
    if cells == 0.0 or not row.any():
        return row
    whole = int(np.floor(cells))
    to, share = np.arange(len(row)) + whole, cells - whole
    moved = np.zeros_like(row)
    np.add.at(moved, np.clip(to, 0, len(row) - 1), (1.0 - share) * row)
    np.add.at(moved, np.clip(to + 1, 0, len(row) - 1), share * row)
    return moved
