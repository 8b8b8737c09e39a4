"""Factor on C, V and B of two successive nodes: the motion increment of the IMU or of the motion model."""

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from terrafix.core.geodesy import local_rotation_up
from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import MIN_HEIGHT_M, robust_noise
from terrafix.estimator.models.motion_model import MotionIncrement
from terrafix.estimator.state import (
    ACCELERATIONS,
    CALIBRATION_SIZE,
    DELTA_MOTION,
    DELTA_P,
    DELTA_P_V,
    DELTA_V,
    HEADING,
    HEIGHT,
    HORIZONTAL,
    INCREMENT_SIZE,
    MOTION_SIZE,
    POSE_SIZE,
    ROTATION,
    TRANSLATION,
    UP,
    VELOCITY,
)


def motion_factor(
    before: tuple[int, int],
    after: tuple[int, int],
    bias_keys: tuple[int, int],
    increment: MotionIncrement,
    camera: gtsam.Rot3,
    focal: FocalKey | None = None,
) -> gtsam.CustomFactor:
    """``before`` and ``after``: keys of C and V; ``bias_keys``: keys of B at both ends. The heading bias at the end
    rotates the measured part of the increment. ``camera``: orientation of the camera at the end by which the increment
    was made; its axes and its noise turn with that camera.

    The residual is the same for a flight that is rotated as a whole about the vertical, and so is its linearization at
    any values: no measurement of this factor observes that rotation, and linearization errors must not observe it
    either (Huang, Mourikis and Roumeliotis 2010, "Observability-based rules for designing consistent EKF SLAM
    estimators"). In fixed world axes a residual that is not zero where it is linearised made the yaw known to half of
    its true 1-sigma within seconds, and moved it.

    Without a DEM (``MotionIncrement.terrain_unknown``), C is the height above whatever ground is seen, as if all ground
    were at one level. The rise of the ground is in the height bias, which the barometer observes. The rise of the
    vehicle is the sum of both.

    An increment of the motion model, without an IMU, is heavy-tailed: drones cruise for minutes and then brake as hard
    as they can. Under a Gaussian increment the cruise velocity persists, and the error goes into the height, by which
    the camera scales its motion. GTSAM computes the robust weight at the linearization point, before the system is
    solved: an initial velocity that does not fit the motion counts as a manoeuvre. Without odometry
    (``MotionIncrement.height_scale_ref`` is None) the increment is Gaussian, because no other measurement would be
    distorted.

    ``focal``: where the focal length is a variable, the residual is in heights as seen through the described lens. In
    true heights it would be the smaller the longer the estimated focal length is: the map gives the distances, so
    that the heights alone grow with the focal length.

    The residual is linear but for the heading bias, the axes of the poses, their turn since the increment was made, and
    the height that scales the increment (``MotionIncrement.height_scale_ref``)."""
    by_before, by_after = -increment.transition(), np.zeros((INCREMENT_SIZE, MOTION_SIZE))
    by_after[DELTA_MOTION, :] = np.eye(MOTION_SIZE)
    delta = np.concatenate([increment.delta_p_m, increment.delta_v_mps])
    camera_inverse = camera.inverse()

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c0, c1 = values.atPose3(before[0]), values.atPose3(after[0])
        v0, v1 = values.atVector(before[1]), values.atVector(after[1])
        b1 = values.atVector(bias_keys[1])
        turn = local_rotation_up(-float(gtsam.Rot3.Logmap(c1.rotation().compose(camera_inverse))[UP]))
        v0, v1 = _turned(v0, turn), _turned(v1, turn)
        measured = _rotated(delta, float(b1[HEADING]) if increment.inertial else 0.0)
        measured = np.concatenate([turn @ measured[DELTA_P], turn @ measured[DELTA_V]])
        start = by_before @ v0
        start[DELTA_P_V] -= measured
        start[DELTA_P] += turn @ (c1.translation() - c0.translation())
        if increment.terrain_unknown:
            start[UP] += float(b1[HEIGHT] - values.atVector(bias_keys[0])[HEIGHT])
        longer = 1.0 if focal is None else math.exp(float(values.atVector(focal.key)[0]) - focal.at)
        scale0, scale1 = _height_scales(increment, c0, c1, longer)
        residual = scale0 * start
        residual[DELTA_MOTION] += scale1 * v1
        if jacobians is not None:
            at = _Linearization(c0, c1, v0, v1, turn, measured, start, scale0, scale1, longer)
            by_c0, by_c1 = _pose_jacobians(increment, at)
            by_v0, by_v1 = scale0 * by_before, scale1 * by_after
            by_v0[:, VELOCITY], by_v1[:, VELOCITY] = by_v0[:, VELOCITY] @ turn, by_v1[:, VELOCITY] @ turn
            by_bias = _calibration_jacobian(increment, at)
            if increment.terrain_unknown:
                by_bias[UP, HEIGHT] += scale0
                jacobians[5] = np.zeros((INCREMENT_SIZE, CALIBRATION_SIZE), order="F")
                jacobians[5][UP, HEIGHT] = -scale0
            for i, jacobian in enumerate((by_c0, by_v0, by_c1, by_v1, by_bias)):
                jacobians[i] = np.asfortranarray(jacobian)
            if focal is not None:
                by_focal = residual if increment.height_scale_ref is not None else np.zeros_like(residual)
                jacobians[-1] = np.asfortranarray(by_focal[:, None])
        return residual

    heavy_tailed = not increment.inertial and increment.height_scale_ref is not None
    noise = robust_noise(increment.cov) if heavy_tailed else gtsam.noiseModel.Gaussian.Covariance(increment.cov, False)
    keys = [*before, *after, bias_keys[1]]
    keys += [bias_keys[0]] if increment.terrain_unknown else []
    return custom_factor(noise, keys if focal is None else [*keys, focal.key], error)


@dataclass(frozen=True)
class _Linearization:
    """Values at which the Jacobians are taken. ``turn`` (3, 3): from the world into the axes of the increment; ``v0``,
    ``v1``: V, ``measured`` (6,): position and velocity increment, ``start`` (INCREMENT_SIZE,): the residual in metres
    without V at the end, all in these axes; ``scale0``, ``scale1``: factors that turn metres into heights, of ``start``
    and of V at the end; ``longer``: true focal length over the one of the increment's reference height."""

    c0: gtsam.Pose3
    c1: gtsam.Pose3
    v0: np.ndarray
    v1: np.ndarray
    turn: np.ndarray
    measured: np.ndarray
    start: np.ndarray
    scale0: float
    scale1: float
    longer: float


def _turned(v: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """V (MOTION_SIZE,) with the velocity in the axes of ``turn`` (3, 3); the accelerations are in those of the
    heading."""
    return np.concatenate([turn @ v[VELOCITY], v[ACCELERATIONS]])


def _rotated(delta: np.ndarray, heading_rad: float) -> np.ndarray:
    """``delta`` (6,), position and velocity increment, rotated about up."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    px, py, pz, vx, vy, vz = delta
    return np.array([c * px - s * py, s * px + c * py, pz, c * vx - s * vy, s * vx + c * vy, vz])


def _height_scales(increment: MotionIncrement, c0: gtsam.Pose3, c1: gtsam.Pose3, longer: float) -> tuple[float, float]:
    """-> reference height over actual height, at the beginning and at the end; 1 for an increment in metres.
    ``longer``: true focal length over the one through which the reference height was seen."""
    if increment.height_scale_ref is None:
        return 1.0, 1.0
    height_m, ground_m = increment.height_scale_ref
    height_m *= longer
    scale1 = height_m / max(float(c1.translation()[UP]) - ground_m, MIN_HEIGHT_M)
    if increment.inertial:
        return scale1, scale1
    return height_m / max(float(c0.translation()[UP]) - ground_m, MIN_HEIGHT_M), scale1


def _pose_jacobians(increment: MotionIncrement, at: _Linearization) -> tuple[np.ndarray, np.ndarray]:
    """-> by C at the beginning and at the end, (INCREMENT_SIZE, 6) each."""
    by_c0, by_c1 = np.zeros((INCREMENT_SIZE, POSE_SIZE)), np.zeros((INCREMENT_SIZE, POSE_SIZE))
    by_c0[DELTA_P, TRANSLATION] = -at.scale0 * at.turn @ at.c0.rotation().matrix()
    by_c1[DELTA_P, TRANSLATION] = at.scale0 * at.turn @ at.c1.rotation().matrix()
    up0, up1 = at.c0.rotation().matrix()[UP], at.c1.rotation().matrix()[UP]
    by_c1[:, ROTATION] = np.outer(_by_turn(increment, at), up1)
    if increment.height_scale_ref is not None:
        height_m = increment.height_scale_ref[0] * at.longer
        by_start, up = (by_c1, up1) if increment.inertial else (by_c0, up0)
        by_start[:, TRANSLATION] -= np.outer(at.start, up) * (at.scale0**2 / height_m)
        by_c1[DELTA_MOTION, TRANSLATION] -= np.outer(at.v1, up1) * (at.scale1**2 / height_m)
    return by_c0, by_c1


def _by_turn(increment: MotionIncrement, at: _Linearization) -> np.ndarray:
    """(INCREMENT_SIZE,) by the yaw of the camera at the end: what the residual contains in world axes turns back."""
    accelerations = increment.transition()[DELTA_P_V, ACCELERATIONS] @ at.v0[ACCELERATIONS]
    x, y, _, vx, vy, _ = at.scale0 * (at.start[DELTA_P_V] + accelerations)
    v1_east, v1_north = at.scale1 * at.v1[HORIZONTAL]
    by_turn = np.zeros(INCREMENT_SIZE)
    by_turn[DELTA_P_V] = np.array([y, -x, 0.0, vy + v1_north, -vx - v1_east, 0.0])
    return by_turn


def _calibration_jacobian(increment: MotionIncrement, at: _Linearization) -> np.ndarray:
    """(INCREMENT_SIZE, CALIBRATION_SIZE) by B at the end, without the height bias."""
    by_bias = np.zeros((INCREMENT_SIZE, CALIBRATION_SIZE))
    if increment.inertial:
        px, py, _, vx, vy, _ = at.measured
        by_bias[DELTA_P_V, HEADING] = at.scale0 * np.array([py, -px, 0.0, vy, -vx, 0.0])
    return by_bias
