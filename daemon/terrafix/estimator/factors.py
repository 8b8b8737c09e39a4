"""The one factor that GTSAM lacks: what an autopilot says of attitude and height, seen through the camera's mount.

Variables of a node k: C_k, the camera pose in the world (Pose3), and B_k, a vector of four slow errors
(mount tilt about the camera's x and y axes [rad], heading bias [rad], height bias [m])."""

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np

from terrafix.core.pose import exp_so3, log_so3

BIAS_SIZE = 4


def attitude_and_height_residual(
    pose: gtsam.Pose3, bias: np.ndarray, r_w_b: np.ndarray, r_b_c: np.ndarray, up_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> residual (4,): rotation about east, north, up [rad] and height [m]; Jacobians by C_k (4x6) and B_k (4x4).

    Jacobians are those of small residuals: exact enough below 15 degrees, and the graph relinearises."""
    r_w_c = pose.rotation().matrix()
    heading = exp_so3(np.array([0.0, 0.0, bias[2]]))  # a positive bias reads too far clockwise: turn it back
    tilt = exp_so3(np.array([bias[0], bias[1], 0.0]))
    expected = heading @ r_w_b @ r_b_c @ tilt
    rotation_w = r_w_c @ log_so3(expected.T @ r_w_c)
    height = float(pose.translation()[2]) - (up_m - bias[3])
    by_pose = np.zeros((4, 6))
    by_pose[:3, :3] = r_w_c
    by_pose[3, 3:] = r_w_c[2]
    by_bias = np.zeros((4, BIAS_SIZE))
    by_bias[:3, :2] = -r_w_c[:, :2]
    by_bias[2, 2] = -1.0
    by_bias[3, 3] = 1.0
    return np.array([*rotation_w, height]), by_pose, by_bias


def attitude_and_height_factor(
    pose_key: int, bias_key: int, sigmas: np.ndarray, r_w_b: np.ndarray, r_b_c: np.ndarray, up_m: float
) -> gtsam.CustomFactor:
    """``sigmas`` (4,): rotation about east, north, up [rad], height [m]; large where nothing is known."""

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        residual, by_pose, by_bias = attitude_and_height_residual(
            values.atPose3(pose_key), values.atVector(bias_key), r_w_b, r_b_c, up_m
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_pose)
            jacobians[1] = np.asfortranarray(by_bias)
        return residual

    callback: Callable[..., np.ndarray] = error
    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), [pose_key, bias_key], callback)
