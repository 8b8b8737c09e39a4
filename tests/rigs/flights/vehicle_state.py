"""State of a simulated vehicle in level flight."""

import math
from dataclasses import replace

import numpy as np

from terrafix_lab.sim.flights.path import STEP_S as STEP_S
from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.vehicle.level import level_state


def state(t_s: float, **changes: object) -> State:
    """Level flight to the east at 20 m/s, 100 m above ground at 400 m."""
    level = level_state(t_s, np.array([20.0 * t_s, 0.0, 500.0]), 20.0, math.pi / 2)
    return replace(level, **{"agl_m": 100.0} | changes)  # type: ignore[arg-type]


def changes(values: np.ndarray, steps: int) -> float:
    """-> RMS change [deg] of ``values`` (N, M) [rad] over a number of rows."""
    return math.degrees(math.sqrt(np.mean(np.square(values[:, steps:] - values[:, :-steps]))))
