"""Level flight along headings that are given: courses of flights as messages, which need no aircraft."""

import math

import numpy as np

from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.vehicle.motion import GRAVITY_MPS2


def level_path(
    yaw_rad: np.ndarray, step_m: np.ndarray | float, start_m: np.ndarray | tuple[float, float]
) -> np.ndarray:
    """(N, 2) positions, east and north, from ``start_m``. ``yaw_rad`` (N,): clockwise from north; ``step_m`` (N,), or
    one of all: way from each position to the next."""
    steps = np.asarray(step_m)[..., None] * np.column_stack([np.sin(yaw_rad), np.cos(yaw_rad)])
    return np.asarray(start_m + np.vstack([np.zeros(2), np.cumsum(steps[:-1], axis=0)]))


def level_state(t_s: float, p_m: np.ndarray, speed_mps: float, yaw_rad: float, turn_radps: float = 0.0) -> State:
    """In a coordinated turn, in still air, 120 m above the ground. ``p_m`` (3,): east, north, up [m]."""
    roll_rad = math.atan2(speed_mps * turn_radps, GRAVITY_MPS2)
    return State(
        t_s=t_s,
        p_b_in_w_m=p_m,
        velocity_enu_mps=speed_mps * np.array([math.sin(yaw_rad), math.cos(yaw_rad), 0.0]),
        yaw_rad=yaw_rad,
        pitch_rad=0.0,
        roll_rad=roll_rad,
        agl_m=120.0,
        rates_b_radps=turn_radps * np.array([0.0, math.sin(roll_rad), math.cos(roll_rad)]),
        force_b_mps2=np.array([0.0, 0.0, -GRAVITY_MPS2 / math.cos(roll_rad)]),
        airspeed_mps=speed_mps,
    )
