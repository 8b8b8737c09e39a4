"""Factor on V_k and B_k: velocity by airspeed, heading and wind."""

from typing import Any

import gtsam
import numpy as np

from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.state import HEADING, HORIZONTAL


def heading_vector(heading_rad: float) -> np.ndarray:
    """(2,) unit vector, east and north, of a heading clockwise from north."""
    return np.array([np.sin(heading_rad), np.cos(heading_rad)])


def airspeed_factor(
    velocity_key: int, bias_key: int, wind_mps: np.ndarray, still_mps: float, yaw_rad: float, cov: np.ndarray
) -> gtsam.CustomFactor:
    """``wind_mps`` (2,), east and north; ``still_mps``: speed over ground in calm air along the heading; ``yaw_rad``:
    reported heading; ``cov`` (2, 2) of the velocity. Robust, because pitot tubes ice up and fill with water."""

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        v, bias = values.atVector(velocity_key), values.atVector(bias_key)
        if jacobians is not None:
            by_v, by_b = np.zeros((2, len(v)), order="F"), np.zeros((2, len(bias)), order="F")
            by_v[:, HORIZONTAL] = np.eye(2)
            east, north = still_mps * heading_vector(yaw_rad - bias[HEADING])
            by_b[:, HEADING] = north, -east
            jacobians[:] = [by_v, by_b]
        velocity_mps = wind_mps + still_mps * heading_vector(yaw_rad - float(bias[HEADING]))
        return np.asarray(v[HORIZONTAL] - velocity_mps)

    return custom_factor(robust_noise(cov), [velocity_key, bias_key], error)
