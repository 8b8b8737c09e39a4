"""The reported heading against the one to which odometry has turned."""

import math

import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.state import WORLD_YAW, NodeState

HEADING_GATE_SIGMAS = 8.0  # of compass, graph and motion together: soft iron stays below [tuned]
COMPASS_SWING_RAD = np.radians(5.0)  # 1-sigma, by which the bias of a compass changes with the heading [tuned]


def heading_innovation(
    state: FilterState, attitude: Attitude, parent: int, r_kf_c: np.ndarray, before: NodeState
) -> Innovation:
    """The reported heading less the predicted one [rad], of a frame that has turned by ``r_kf_c`` (3, 3) since its
    keyframe, node ``parent``. ``before``: the newest node. Zero where no heading is reported."""
    assert state.last is not None
    yaw_rad = state.camera.yaw_rad(state.graph.state(parent).pose.rotation().matrix() @ r_kf_c)
    cov = tangent_to_world(state.last.cov, before.pose.rotation().matrix())
    reported2 = np.radians(state.origin.yaw_sigma_deg) ** 2 + attitude.turned_rad**2
    sigma_rad = float(np.sqrt(reported2 + COMPASS_SWING_RAD**2 + cov[WORLD_YAW, WORLD_YAW]))
    if attitude.yaw_rad is None:
        return Innovation.scalar(0.0, sigma_rad, HEADING_GATE_SIGMAS)
    reported_rad = state.camera.yaw_rad(state.camera.expected(attitude, before.calibration))
    return Innovation.scalar(math.remainder(reported_rad - yaw_rad, math.tau), sigma_rad, HEADING_GATE_SIGMAS)
