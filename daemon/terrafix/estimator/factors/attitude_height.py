"""Factor on C_k and B_k: the autopilot's attitude and height, through the camera mount."""

import math
from typing import Any

import gtsam
import numpy as np

from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import log_so3
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.state import (
    CALIBRATION_SIZE,
    HEADING,
    HEIGHT,
    LOG_HEIGHT_SCALE,
    MOUNT_TILT,
    MOUNT_TILT_X,
    MOUNT_TILT_Y,
    POSE_SIZE,
    ROTATION,
    TRANSLATION,
    UP,
)

# Rows of the residual.
ROTATION_ROWS, YAW_ROW, HEIGHT_ROW = slice(0, 3), 2, 3  # [spec: layout of the residual]


def mount_tilt_rotation(x_rad: float, y_rad: float) -> np.ndarray:
    """R (3x3) of a mount tilt about the camera's x and y axes, by Rodrigues' formula."""
    angle2 = x_rad * x_rad + y_rad * y_rad
    angle = math.sqrt(angle2)
    s = math.sin(angle) / angle if angle > 1e-9 else 1.0
    c = (1.0 - math.cos(angle)) / angle2 if angle > 1e-9 else 0.5
    return np.array(
        [
            [1.0 - c * y_rad * y_rad, c * x_rad * y_rad, s * y_rad],
            [c * x_rad * y_rad, 1.0 - c * x_rad * x_rad, -s * x_rad],
            [-s * y_rad, s * x_rad, 1.0 - c * angle2],
        ]
    )


def attitude_height_residual(
    pose: gtsam.Pose3, bias: np.ndarray, r_w_b: np.ndarray, r_b_c: np.ndarray, up_m: float, ground_m: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> residual (4,): rotation about east, north, up [rad] and height [m]; Jacobians by C_k (4x6) and B_k (4x6).

    ``up_m`` is the reported height, AMSL; ``ground_m``, AMSL, is the level above which the height scale applies. The
    height bias applies to the seen height, as does the rise of ground that no DEM gives.

    The Jacobians hold for small residuals. They are exact enough below 15 degrees, and the graph relinearises."""
    r_w_c = pose.rotation().matrix()
    heading = local_rotation_up(float(bias[HEADING]))  # a positive bias reads too far clockwise: turn it back
    expected = heading @ r_w_b @ r_b_c @ mount_tilt_rotation(float(bias[MOUNT_TILT_X]), float(bias[MOUNT_TILT_Y]))
    rotation_w = log_so3(r_w_c @ expected.T)
    scale, seen_m = (math.exp(float(bias[LOG_HEIGHT_SCALE])), float(pose.translation()[UP] + bias[HEIGHT]) - ground_m)
    height = scale * seen_m - (up_m - ground_m)
    by_pose = np.zeros((4, POSE_SIZE))
    by_pose[ROTATION_ROWS, ROTATION] = r_w_c
    by_pose[HEIGHT_ROW, TRANSLATION] = scale * r_w_c[UP]
    by_bias = np.zeros((4, CALIBRATION_SIZE))
    by_bias[ROTATION_ROWS, MOUNT_TILT] = -r_w_c[:, :2]
    by_bias[YAW_ROW, HEADING] = -1.0
    by_bias[HEIGHT_ROW, HEIGHT], by_bias[HEIGHT_ROW, LOG_HEIGHT_SCALE] = scale, scale * seen_m
    return np.array([*rotation_w, height]), by_pose, by_bias


def attitude_height_factor(
    pose_key: int, bias_key: int, sigmas: np.ndarray, r_w_b: np.ndarray, r_b_c: np.ndarray, up_m: float, ground_m: float
) -> gtsam.CustomFactor:
    """``sigmas`` (4,): rotation about east, north, up [rad], height [m]; large for components that are not reported."""

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        residual, by_pose, by_bias = attitude_height_residual(
            values.atPose3(pose_key), values.atVector(bias_key), r_w_b, r_b_c, up_m, ground_m
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_pose)
            jacobians[1] = np.asfortranarray(by_bias)
        return residual

    return custom_factor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), [pose_key, bias_key], error)
