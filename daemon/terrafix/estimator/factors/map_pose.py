"""Factor on C_k and B_k: a camera pose from a map match."""

from typing import Any

import gtsam
import numpy as np

from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.state import CALIBRATION_SIZE, POSE_SIZE, RADIAL_K1


def map_pose_factor(
    pose_key: int, bias_key: int, pose: gtsam.Pose3, cov: np.ndarray, by_k1: np.ndarray, k1: float
) -> gtsam.CustomFactor:
    """``pose`` of the camera with covariance ``cov`` (6, 6), tangent order, computed from rays of a lens with radial
    coefficient ``k1``. ``by_k1`` (6,): change of the pose, tangent order, by a change of the coefficient.

    The lens error is common to all fixes. As noise of each fix it would average out, which it does not."""
    by_bias = np.zeros((POSE_SIZE, CALIBRATION_SIZE), order="F")
    by_bias[:, RADIAL_K1] = -by_k1

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        lens_shift = by_k1 * (values.atVector(bias_key)[RADIAL_K1] - k1)
        if jacobians is not None:
            jacobians[0], jacobians[1] = np.eye(POSE_SIZE, order="F"), by_bias
        return np.asarray(-values.atPose3(pose_key).localCoordinates(pose) - lens_shift)

    return custom_factor(robust_noise(cov), [pose_key, bias_key], error)
