"""The two factors that GTSAM lacks: what an autopilot says of attitude and height, seen through the camera's mount,
and two cameras that look at the same ground.

Variables of a node k: C_k, the camera pose in the world (Pose3), and B_k, a vector of four slow errors
(mount tilt about the camera's x and y axes [rad], heading bias [rad], height bias [m])."""

from typing import Any

import gtsam
import numpy as np

from terrafix.core.pose import exp_so3, log_so3, project_with_jacobian, skew
from terrafix.estimator.motion import EFFECTIVE_PAIRS, Ground

BIAS_SIZE = 4
BLOCK_HUBER_K = 1.5


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

    return gtsam.CustomFactor(gtsam.noiseModel.Diagonal.Sigmas(sigmas), [pose_key, bias_key], error)


def same_ground_residual(
    keyframe: gtsam.Pose3, pose: gtsam.Pose3, pairs: np.ndarray, normal: np.ndarray, offset: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Rays of the keyframe meet the plane ``normal . X = offset`` and are projected into the other camera.

    -> residual (2N,) normalised, Jacobians by both poses (2N x 6), the points X (N, 3), and the change of the residual
    by the height of the plane at each point (2N,). Both cameras move the points: a tilt of the keyframe that is wrong
    must not turn into a turn of the next camera."""
    r_kf, p_kf = keyframe.rotation().matrix(), keyframe.translation()
    r_k, p_k = pose.rotation().matrix(), pose.translation()
    rays = np.column_stack([pairs[:, :2], np.ones(len(pairs))])
    d = rays @ r_kf.T
    along = d @ normal
    along = np.where(np.abs(along) < 1e-3, -1e-3, along)
    depth = (offset - float(normal @ p_kf)) / along
    points = p_kf + d * depth[:, None]
    predicted, by_pose, _ = project_with_jacobian(r_k, p_k, points)
    residual = (predicted - pairs[:, 2:]).ravel()
    # Moving the point X moves its image like moving the camera the other way: d(image)/dX = -by_pose[translation] R^T.
    by_point = -by_pose[:, :, 3:] @ r_k.T
    slide = np.eye(3) - np.einsum("ni,j->nij", d / along[:, None], normal)  # along the ray, back onto the plane
    by_ray = by_point @ slide
    cross = np.array([skew(ray) for ray in rays])
    by_keyframe = np.concatenate([-depth[:, None, None] * (by_ray @ r_kf @ cross), by_ray @ r_kf], axis=2)
    by_height = np.einsum("nij,nj->ni", by_point, d / along[:, None])
    n = 2 * len(pairs)
    return residual, by_keyframe.reshape(n, 6), by_pose.reshape(n, 6), points, by_height.ravel()


def same_ground_factor(
    keyframe_key: int,
    pose_key: int,
    keyframe: gtsam.Pose3,
    pose: gtsam.Pose3,
    pairs: np.ndarray,
    sigma: float,
    ground: Ground,
) -> gtsam.CustomFactor:
    """``pairs`` (N, 4) normalised with the 1-sigma ``sigma`` of a coordinate. The plane below the keyframe is not known
    exactly: what its height and slope leave open is in the noise of the factor."""
    normal = np.array([-ground.slope_e, -ground.slope_n, 1.0])
    p = keyframe.translation()
    offset = float(p[2]) - ground.height_m - ground.slope_e * float(p[0]) - ground.slope_n * float(p[1])
    _, _, _, points, by_height = same_ground_residual(keyframe, pose, pairs, normal, offset)
    away = np.repeat(points[:, :2] - p[:2], 2, axis=0)
    by_plane = np.column_stack([by_height, by_height * away[:, 0], by_height * away[:, 1]])
    plane = np.diag([ground.level_sigma_m, ground.slope_sigma, ground.slope_sigma]) ** 2
    noise = gtsam.noiseModel.Gaussian.Covariance(
        sigma**2 * np.eye(2 * len(pairs)) + by_plane @ plane @ by_plane.T, False
    )

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        residual, by_keyframe, by_pose, _, _ = same_ground_residual(
            values.atPose3(keyframe_key), values.atPose3(pose_key), pairs, normal, offset
        )
        if jacobians is not None:
            jacobians[0] = np.asfortranarray(by_keyframe)
            jacobians[1] = np.asfortranarray(by_pose)
        return residual

    # Huber on the whole block: its whitened norm is about sqrt(2 * EFFECTIVE_PAIRS) when all is well.
    huber = gtsam.noiseModel.mEstimator.Huber.Create(BLOCK_HUBER_K * float(np.sqrt(2 * EFFECTIVE_PAIRS)))
    return gtsam.CustomFactor(gtsam.noiseModel.Robust.Create(huber, noise), [keyframe_key, pose_key], error)
