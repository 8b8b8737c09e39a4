"""State of a simulated vehicle in level flight."""

import math
from dataclasses import replace

import numpy as np

from terrafix_lab.sim.interfaces import State

STEP_S = 0.02


def state(t_s: float, **changes: object) -> State:
    """Level flight to the east at 20 m/s, 100 m above ground at 400 m."""
    level = State(
        t_s=t_s,
        p_b_in_w_m=np.array([20.0 * t_s, 0.0, 500.0]),
        velocity_enu_mps=np.array([20.0, 0.0, 0.0]),
        yaw_rad=math.pi / 2,
        pitch_rad=0.0,
        roll_rad=0.0,
        agl_m=100.0,
        rates_b_radps=np.zeros(3),
        force_b_mps2=np.array([0.0, 0.0, -9.80665]),
        airspeed_mps=20.0,
    )
    return replace(level, **changes)  # type: ignore[arg-type]


def changes(values: np.ndarray, steps: int) -> float:
    """-> RMS change [deg] of ``values`` (N, M) [rad] over a number of rows."""
    return math.degrees(math.sqrt(np.mean(np.square(values[:, steps:] - values[:, :-steps]))))
