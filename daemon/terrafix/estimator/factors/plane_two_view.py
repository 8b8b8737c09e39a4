"""Factor on C of a keyframe and of a later camera, and on B: matched rays over a common ground plane.

The residual is the plane-induced motion of the matches (Hartley and Zisserman, "Multiple View Geometry", 2004, ch. 13),
reduced by QR to REDUCED_SIZE numbers."""

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from terrafix.core.pose import project_with_jacobian
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import MIN_HEIGHT_M, whiten_common
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS, Ground, MatchedRays
from terrafix.estimator.state import (
    CALIBRATION_SIZE,
    EAST,
    HEIGHT,
    HORIZONTAL,
    NORTH,
    POSE_SIZE,
    RADIAL_K1,
    ROTATION,
    TRANSLATION,
    UP,
)

BLOCK_HUBER_K = 1.5  # Huber threshold, in expected norms of the whitened residual of one pair of cameras [tuned]
# 1-sigma of the lens distortion that the radial coefficient does not model: of the coefficient itself, and as a share
# of its estimate. The modelled part is equal in all frames and looks like a tilt that grows with the distance flown,
# so it is a state; the rest is noise. [tuned]
K1_MODEL_SIGMA, K1_MODEL_SHARE = 0.0015, 0.05
# 6 of the step, 3 of the keyframe's tilt, 1 of the lens, 1 unexplained norm [spec: columns of the QR]
REDUCED_SIZE = 11
STEP_AND_CONSTANT = [0, 1, 2, 3, 4, 5, 10]  # columns of the QR [spec: order of the stacked Jacobian]
TILT_COLUMNS, K1_COLUMN = slice(6, 9), 9  # [spec: order of the stacked Jacobian]
STEP_COLUMNS, CONSTANT_COLUMN = slice(0, 6), 6  # of the reduced step and constant [spec: STEP_AND_CONSTANT]
RADIAL, UNIFORM = 2, 0  # powers of the distance from the centre [spec: division model; focal length]
RIGHT_DOWN = slice(3, 5)  # translation within the image plane [spec: tangent order of a pose]


@dataclass(frozen=True)
class _Plane:
    """``normal . X = offset`` in the world; ``normal`` (3,) has an up component of 1. ``k1_sigma``, ``focal_sigma``:
    1-sigma of the radial coefficient and of the relative focal length that is noise."""

    ground: Ground
    normal: np.ndarray
    offset: float
    k1_sigma: float
    focal_sigma: float


@dataclass(frozen=True)
class LensNoise:
    """1-sigma of the lens in the noise of a factor: radial coefficient, and relative focal length."""

    k1: float
    focal: float


@dataclass(frozen=True)
class _Reduced:
    """Whitened linear residual around the first estimate of both cameras. ``by_step`` (R, 7): by the pose of the camera
    in the keyframe, and the constant; ``by_tilt`` (R, 3): by a rotation of the keyframe; ``by_k1`` (R,)."""

    by_step: np.ndarray
    by_tilt: np.ndarray
    by_k1: np.ndarray


def same_ground_residual(
    keyframe: gtsam.Pose3, pose: gtsam.Pose3, pairs: np.ndarray, normal: np.ndarray, offset: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Intersects the keyframe's rays with the plane ``normal . X = offset`` and projects the points into the camera.

    ``pairs`` (N, 4), normalised (keyframe x, y, camera x, y). -> residual (2N,), normalised; Jacobians by both poses
    (2N x 6); points X (N, 3); change of the residual by the height of the plane at each point (2N,). Both cameras move
    the points, so that a tilt error of the keyframe does not become a rotation of the camera."""
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
    by_point = -by_pose[:, :, TRANSLATION] @ r_k.T
    by_height = np.einsum("nij,nj->ni", by_point, d / along[:, None])
    x, y, z = np.moveaxis((by_point - by_height[:, :, None] * normal) @ r_kf, 2, 0)  # along the ray, back to the plane
    by_keyframe = np.empty_like(by_pose)
    by_keyframe[:, :, 0] = depth[:, None] * (z * rays[:, 1:2] - y)  # by rotation: cross product with the ray
    by_keyframe[:, :, 1] = depth[:, None] * (x - z * rays[:, :1])
    by_keyframe[:, :, 2] = depth[:, None] * (y * rays[:, :1] - x * rays[:, 1:2])
    by_keyframe[:, :, TRANSLATION] = np.stack([x, y, z], 2)
    n = 2 * len(pairs)
    return residual, by_keyframe.reshape(n, POSE_SIZE), by_pose.reshape(n, POSE_SIZE), points, by_height.ravel()


def plane_two_view_factor(
    keyframe_key: int,
    pose_key: int,
    bias_key: int,
    keyframe: gtsam.Pose3,
    pose: gtsam.Pose3,
    rays: MatchedRays,
    keyframe_bias_key: int | None = None,
    lens: LensNoise | None = None,
) -> gtsam.CustomFactor:
    """``keyframe``, ``pose``: first estimates. The uncertainty of height and slope of the plane is part of the noise.

    Two cameras above a plane have nine parameters: the pose of one in the other, with the translation in units of the
    keyframe's height, and the keyframe's tilt against the plane. The radial coefficient is a tenth. In these the
    residuals of all pairs are linear enough to be reduced by QR, once, to REDUCED_SIZE residuals of the same norm, the
    last of which is unexplained. Heading and position of the cameras do not enter, so that a later correction of
    either does no harm. With the translation in metres, the unexplained part would weigh less the lower the camera is,
    and would pull the estimate down.

    ``keyframe_bias_key``: B of the keyframe. It enters only where the elevation between both is unknown
    (``rise_sigma_m``; see ``motion_factor``). ``lens``: where other factors determine the lens. Relief looks
    like a lens error for as long as it is in view, and is not on the plane; None: as in flight, where the height is a
    height as seen through the described lens, and the pairs determine the radial coefficient."""
    ground, k1 = rays.ground, rays.k1
    if not ground.rise_sigma_m:
        keyframe_bias_key = None
    model = _linear_model(keyframe, pose, rays, lens or LensNoise(0.0, 0.0))
    first_up_m = keyframe.translation()[UP]

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c0, c1 = values.atPose3(keyframe_key), values.atPose3(pose_key)
        bias = values.atVector(bias_key)
        if keyframe_bias_key is not None:
            rise_m = float(bias[HEIGHT] - values.atVector(keyframe_bias_key)[HEIGHT])
            c1 = gtsam.Pose3(c1.rotation(), c1.translation() + np.array([0.0, 0.0, rise_m]))
        # The plane keeps its level below the keyframe when the keyframe moves sideways: with a slope, a position error
        # along a hillside would be observable through the height, which it is not.
        height_m = max(ground.height_m + float(c0.translation()[UP] - first_up_m), MIN_HEIGHT_M)
        now = _Pair(c0, c1, c0.between(c1), height_m, ground.height_m / height_m)
        residual = model.residual(now, bias[RADIAL_K1] - k1)
        if jacobians is not None:
            by_c0, by_c1 = model.pose_jacobians(now)
            jacobians[0] = np.asfortranarray(by_c0)
            jacobians[1] = np.asfortranarray(by_c1)
            jacobians[2] = model.by_bias
            if keyframe_bias_key is not None:
                by_rise = np.zeros_like(model.by_bias)
                by_rise[:, HEIGHT] = by_c1[:, TRANSLATION] @ c1.rotation().matrix()[UP]
                jacobians[2], jacobians[3] = np.asfortranarray(model.by_bias + by_rise), np.asfortranarray(-by_rise)
        return np.asarray(residual)

    # Huber loss on the whole block: its whitened norm is about sqrt(2 * EFFECTIVE_PAIRS) without outliers.
    huber = gtsam.noiseModel.mEstimator.Huber.Create(BLOCK_HUBER_K * float(np.sqrt(2 * EFFECTIVE_PAIRS)))
    noise = gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Unit.Create(REDUCED_SIZE))
    keys = [keyframe_key, pose_key, bias_key]
    return custom_factor(noise, keys if keyframe_bias_key is None else [*keys, keyframe_bias_key], error)


@dataclass(frozen=True)
class _Pair:
    """Both cameras at the values in question: ``c0`` the keyframe, ``c1`` the camera, ``step`` the camera in the
    keyframe, ``height_m`` of the keyframe over the plane, ``scale`` the reference height over ``height_m``."""

    c0: gtsam.Pose3
    c1: gtsam.Pose3
    step: gtsam.Pose3
    height_m: float
    scale: float


@dataclass(frozen=True)
class _LinearModel:
    """``step0``: camera in the keyframe at linearization. ``up_unit`` (3,): unit normal of the plane in the keyframe
    then. ``by_rotation`` (R, 3): by a rotation of the keyframe, without the component about the normal. ``by_bias``
    (R, CALIBRATION_SIZE)."""

    reduced: _Reduced
    normal: np.ndarray
    step0: gtsam.Pose3
    up_unit: np.ndarray
    by_rotation: np.ndarray
    by_bias: np.ndarray

    def residual(self, now: _Pair, k1_change: float) -> np.ndarray:
        """Whitened (R,). ``k1_change``: of the radial coefficient, from the one of the pairs."""
        step, by_step = gtsam.Pose3(now.step.rotation(), now.scale * now.step.translation()), self.reduced.by_step
        up, up_unit = now.c0.rotation().matrix().T @ self.normal, self.up_unit
        # A small rotation w of the keyframe changes up by up x w: converted back to w, without the component about up.
        tilt = np.array(
            [
                up[1] * up_unit[2] - up[2] * up_unit[1],
                up[2] * up_unit[0] - up[0] * up_unit[2],
                up[0] * up_unit[1] - up[1] * up_unit[0],
            ]
        )
        return np.asarray(
            by_step[:, CONSTANT_COLUMN]
            + by_step[:, STEP_COLUMNS] @ self.step0.logmap(step)
            + self.reduced.by_tilt @ tilt
            + self.reduced.by_k1 * k1_change
        )

    def pose_jacobians(self, now: _Pair) -> tuple[np.ndarray, np.ndarray]:
        """-> by the keyframe and by the camera, (R, 6) each."""
        by_step = self.reduced.by_step[:, STEP_COLUMNS]
        by_c1 = np.hstack([by_step[:, ROTATION], now.scale * by_step[:, TRANSLATION]])
        by_c0 = -by_c1 @ now.step.inverse().AdjointMap()
        by_c0[:, ROTATION] += self.by_rotation
        by_height = by_c1[:, TRANSLATION] @ now.step.rotation().matrix().T @ now.step.translation() / -now.height_m
        by_c0[:, TRANSLATION] += np.outer(by_height, now.c0.rotation().matrix()[UP])
        return by_c0, by_c1


def k1_model_sigma(k1: float) -> float:
    """1-sigma of a radial coefficient as one number for a lens."""
    return float(np.hypot(K1_MODEL_SIGMA, K1_MODEL_SHARE * k1))


def _linear_model(keyframe: gtsam.Pose3, pose: gtsam.Pose3, rays: MatchedRays, lens: LensNoise) -> _LinearModel:
    ground = rays.ground
    normal = np.array([-ground.slope_e, -ground.slope_n, 1.0])
    p = keyframe.translation()
    offset = float(p[UP]) - ground.height_m - ground.slope_e * float(p[EAST]) - ground.slope_n * float(p[NORTH])
    k1_sigma = float(np.hypot(k1_model_sigma(rays.k1), lens.k1))
    reduced = _reduced(keyframe, pose, rays, _Plane(ground, normal, offset, k1_sigma, lens.focal))
    by_bias = np.zeros((REDUCED_SIZE, CALIBRATION_SIZE), order="F")
    by_bias[:, RADIAL_K1] = reduced.by_k1
    up_first = keyframe.rotation().matrix().T @ normal
    up_unit = up_first / float(np.linalg.norm(up_first))
    by_rotation = reduced.by_tilt @ (np.eye(3) - np.outer(up_unit, up_unit))
    return _LinearModel(reduced, normal, keyframe.between(pose), up_unit, by_rotation, by_bias)


def _reduced(keyframe: gtsam.Pose3, pose: gtsam.Pose3, rays: MatchedRays, plane: _Plane) -> _Reduced:
    """QR of the Jacobian of all pairs, whitened by the noise of the pairs and of the plane."""
    ground, pairs, sigma = plane.ground, rays.pairs, rays.sigma
    residual, by_keyframe, by_pose, points, by_height = same_ground_residual(
        keyframe, pose, pairs, plane.normal, plane.offset
    )
    # By the keyframe alone, while the camera keeps its pose in it.
    by_both = by_keyframe + by_pose @ keyframe.between(pose).inverse().AdjointMap()
    by_k1 = _by_lens(keyframe, pairs, residual, by_keyframe, points, RADIAL)
    full = np.column_stack([by_pose, by_both[:, ROTATION], by_k1, residual]) / sigma
    from_keyframe_m = np.repeat(points[:, :2] - keyframe.translation()[HORIZONTAL], 2, axis=0)
    by_plane = np.column_stack([by_height, by_height * from_keyframe_m[:, 0], by_height * from_keyframe_m[:, 1]])
    by_plane = by_plane * (np.array([ground.level_sigma_m, ground.slope_sigma, ground.slope_sigma]) / sigma)
    by_plane = np.column_stack([by_plane, plane.k1_sigma / sigma * by_k1])
    if plane.focal_sigma:
        by_focal = _by_lens(keyframe, pairs, residual, by_keyframe, points, UNIFORM)
        by_plane = np.column_stack([by_plane, plane.focal_sigma / sigma * by_focal])
    if ground.curvature_sigma:
        by_curvature = _by_curvature(by_height, from_keyframe_m)
        by_plane = np.column_stack([by_plane, ground.curvature_sigma / sigma * by_curvature])
    r = np.asarray(np.linalg.qr(whiten_common(full, by_plane), mode="r"))
    return _Reduced(r[:, STEP_AND_CONSTANT], r[:, TILT_COLUMNS], r[:, K1_COLUMN])


def _by_curvature(by_height: np.ndarray, from_keyframe_m: np.ndarray) -> np.ndarray:
    """(2N, 3) Jacobian by the curvature of the ground: along east, along north, and the twist, which has a third of the
    variance in an isotropic field. ``from_keyframe_m`` (2N, 2): east and north.

    Curved ground rotates the estimated camera by about a tenth of the change of slope from keyframe to keyframe, with
    the same sign for as long as a hill is in view."""
    east_m, north_m = from_keyframe_m.T
    rises_m = np.column_stack([0.5 * east_m**2, 0.5 * north_m**2, east_m * north_m / np.sqrt(3.0)])
    return np.asarray(by_height[:, None] * rises_m)


def _by_lens(
    keyframe: gtsam.Pose3,
    pairs: np.ndarray,
    residual: np.ndarray,
    by_keyframe: np.ndarray,
    points: np.ndarray,
    power: int,
) -> np.ndarray:
    """(2N,) Jacobian by a number of the lens that moves the rays of both cameras towards the centre, in proportion to
    their distance from it to the power of ``power`` + 1: RADIAL for the radial coefficient, UNIFORM for the logarithm
    of the focal length. A keyframe ray that rotates moves its point as a translation of the camera by as much times the
    depth does.

    The camera's rays are the predicted ones, not the measured ones: noise on both sides of the equation would look
    like a lens error."""
    predicted = pairs[:, 2:] + residual.reshape(-1, 2)
    outward = [
        np.sum(np.square(xy), axis=1, keepdims=True) * xy if power == RADIAL else xy for xy in (pairs[:, :2], predicted)
    ]
    depth = (points - keyframe.translation()) @ keyframe.rotation().matrix()[:, 2]
    by_ray = by_keyframe.reshape(-1, 2, POSE_SIZE)[:, :, RIGHT_DOWN] * depth[:, None, None]
    return np.asarray((outward[1] - np.einsum("nij,nj->ni", by_ray, outward[0])).ravel())
