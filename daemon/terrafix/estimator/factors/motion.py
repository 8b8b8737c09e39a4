"""Factor on C, V and B of two successive nodes: the motion increment of the IMU or of the motion model."""

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.models.motion_model import MotionIncrement
from terrafix.estimator.state import (
    CALIBRATION_SIZE,
    DELTA_MOTION,
    DELTA_P,
    DELTA_P_V,
    HEADING,
    HEIGHT,
    INCREMENT_SIZE,
    MOTION_SIZE,
    POSE_SIZE,
    TRANSLATION,
    UP,
)

MIN_HEIGHT_M = 1.0  # lower bound of a height that the residual is divided by [tuned]


def motion_factor(
    before: tuple[int, int],
    after: tuple[int, int],
    bias_keys: tuple[int, int],
    increment: MotionIncrement,
    focal: FocalKey | None = None,
) -> gtsam.CustomFactor:
    """``before`` and ``after``: keys of C and V; ``bias_keys``: keys of B at both ends. The heading bias at the end
    rotates the measured part of the increment.

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

    The residual is linear but for the heading bias, the axes of the poses, and the height that scales the increment
    (``MotionIncrement.height_scale_ref``)."""
    by_before, by_after = -increment.transition(), np.zeros((INCREMENT_SIZE, MOTION_SIZE))
    by_after[DELTA_MOTION, :] = np.eye(MOTION_SIZE)
    delta = np.concatenate([increment.delta_p_m, increment.delta_v_mps])

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c0, c1 = values.atPose3(before[0]), values.atPose3(after[0])
        v0, v1 = values.atVector(before[1]), values.atVector(after[1])
        b1 = values.atVector(bias_keys[1])
        rotated = _rotated(delta, float(b1[HEADING]) if increment.inertial else 0.0)
        start = by_before @ v0
        start[DELTA_P_V] -= rotated
        start[DELTA_P] += c1.translation() - c0.translation()
        if increment.terrain_unknown:
            start[UP] += float(b1[HEIGHT] - values.atVector(bias_keys[0])[HEIGHT])
        longer = 1.0 if focal is None else math.exp(float(values.atVector(focal.key)[0]) - focal.at)
        scale0, scale1 = _height_scales(increment, c0, c1, longer)
        residual = scale0 * start
        residual[DELTA_MOTION] += scale1 * v1
        if jacobians is not None:
            at = _Linearization(c0, c1, v1, rotated, start, scale0, scale1, longer)
            by_c0, by_c1 = _pose_jacobians(increment, at)
            by_bias = _calibration_jacobian(increment, at)
            if increment.terrain_unknown:
                by_bias[UP, HEIGHT] += scale0
                jacobians[5] = np.zeros((INCREMENT_SIZE, CALIBRATION_SIZE), order="F")
                jacobians[5][UP, HEIGHT] = -scale0
            for i, jacobian in enumerate((by_c0, scale0 * by_before, by_c1, scale1 * by_after, by_bias)):
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
    """Values at which the Jacobians are taken. ``rotated`` (6,): position and velocity increment in the world;
    ``start`` (INCREMENT_SIZE,): the residual in metres without V at the end; ``scale0``, ``scale1``: factors that turn
    metres into heights, of ``start`` and of V at the end; ``longer``: true focal length over the one of the increment's
    reference height."""

    c0: gtsam.Pose3
    c1: gtsam.Pose3
    v1: np.ndarray
    rotated: np.ndarray
    start: np.ndarray
    scale0: float
    scale1: float
    longer: float


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
    by_c0[DELTA_P, TRANSLATION] = -at.scale0 * at.c0.rotation().matrix()
    by_c1[DELTA_P, TRANSLATION] = at.scale0 * at.c1.rotation().matrix()
    if increment.height_scale_ref is not None:
        height_m = increment.height_scale_ref[0] * at.longer
        up0, up1 = at.c0.rotation().matrix()[UP], at.c1.rotation().matrix()[UP]
        by_start, up = (by_c1, up1) if increment.inertial else (by_c0, up0)
        by_start[:, TRANSLATION] -= np.outer(at.start, up) * (at.scale0**2 / height_m)
        by_c1[DELTA_MOTION, TRANSLATION] -= np.outer(at.v1, up1) * (at.scale1**2 / height_m)
    return by_c0, by_c1


def _calibration_jacobian(increment: MotionIncrement, at: _Linearization) -> np.ndarray:
    """(INCREMENT_SIZE, CALIBRATION_SIZE) by B at the end, without the height bias."""
    by_bias = np.zeros((INCREMENT_SIZE, CALIBRATION_SIZE))
    if increment.inertial:
        px, py, _, vx, vy, _ = at.rotated
        by_bias[DELTA_P_V, HEADING] = at.scale0 * np.array([py, -px, 0.0, vy, -vx, 0.0])
    return by_bias
