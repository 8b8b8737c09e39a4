"""The reported height against the predicted one, and what a height does to map matching."""

import numpy as np

from terrafix.core.limits import MIN_MATCHING_AGL_M
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.state import HEIGHT, LOG_HEIGHT_SCALE, UP, NodeState

# 1-sigma of sensor, graph and motion together: gusts, filter steps and rising ground stay below.
HEIGHT_GATE_SIGMAS = 8.0  # [tuned]
LOW_RATIO = 1.5  # of MIN_MATCHING_AGL_M: above this reported height a lower estimate is reset [tuned]


def height_innovation(
    state: FilterState, agl_m: float, p_m: np.ndarray, before: NodeState, moved_m2: float
) -> Innovation:
    """The reported height ``agl_m`` less the one that a camera at ``p_m`` (3,) predicts [m].
    ``moved_m2``: variance of the climb since ``before``, the newest node."""
    assert state.last is not None
    ground_m = state.terrain.elevation_m(p_m)
    expected_m = np.exp(before.calibration[LOG_HEIGHT_SCALE]) * (float(p_m[UP] + before.calibration[HEIGHT]) - ground_m)
    reported_m = (state.origin.ground_amsl_m or 0.0) + agl_m - ground_m
    cov = tangent_to_world(state.last.cov, before.pose.rotation().matrix())
    sigma_m = float(np.sqrt(state.origin.agl_sigma_m**2 + cov[UP, UP] + moved_m2))
    return Innovation.scalar(reported_m - float(expected_m), sigma_m, HEIGHT_GATE_SIGMAS)


def reported_agl_m(state: FilterState, attitude: Attitude, p_m: np.ndarray) -> float:
    """Reported height above the ground below ``p_m`` (3,)."""
    assert attitude.agl_m is not None
    return (state.origin.ground_amsl_m or 0.0) + attitude.agl_m - state.terrain.elevation_m(p_m)


def is_below_map_matching(state: FilterState, attitude: Attitude, p_m: np.ndarray) -> bool:
    """Whether the estimated height of a camera at ``p_m`` (3,) keeps the anchor from matching frames that would correct
    it: below the ground, or while the reported height, above ground that a map tells, would allow that."""
    agl_m = state.terrain.height_above_m(p_m)
    if attitude.stands or agl_m < 0.0:
        return not attitude.stands
    if attitude.agl_m is None or not state.terrain.has_dem or state.yaw_gauge is not None:
        return False
    return agl_m < MIN_MATCHING_AGL_M and reported_agl_m(state, attitude, p_m) > LOW_RATIO * MIN_MATCHING_AGL_M
