"""Camera motion between two frames from the image alone, levelled with the autopilot's attitude."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.plane_motion import similarity_ratio

# Smallest down component of a unit-depth ray: it meets the ground within five heights.
MIN_RAY_DOWN = 0.2  # [spec: 1 / 5]
MIN_VELOCITY_PAIRS = 8  # point pairs [tuned]


@dataclass(frozen=True)
class VisualMotion:
    """``displacement`` (2,): horizontal, east and north, in heights above ground. ``turned_rad``: rotation about the
    optical axis by the image, clockwise; it does not depend on the mount. ``reported_rad``: the same by the
    attitude."""

    displacement: np.ndarray
    turned_rad: float
    reported_rad: float


def visual_motion(pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray) -> VisualMotion | None:
    """Motion from a keyframe to a frame by a 2D similarity on the ground plane.

    ``pairs`` (N, 4): normalised image points of the keyframe and of the frame; ``before``, ``now``: their attitudes;
    R_b_c (3x3): the configured mount. None where an attitude has no heading or too few rays point down."""
    if before.yaw_rad is None or now.yaw_rad is None:
        return None
    motion = _ground_motion(pairs, before, now, r_b_c)
    if motion is None:
        return None
    displacement = motion[0]
    turned = _ratio(pairs[:, 2] + 1j * pairs[:, 3], pairs[:, 0] + 1j * pairs[:, 1])
    reported_rad = float(np.remainder(now.yaw_rad - before.yaw_rad + np.pi, 2 * np.pi) - np.pi)
    return VisualMotion(np.array([displacement.real, displacement.imag]), float(np.angle(turned)), reported_rad)


def image_turn(pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray) -> float | None:
    """-> turn about the vertical from a keyframe to a frame, clockwise [rad], without the headings and heights of both
    attitudes; a tilt that is not known is taken as level. Otherwise as ``visual_motion``."""
    tilt_before, tilt_now = (replace(attitude, yaw_rad=0.0) for attitude in (before, now))
    motion = _ground_motion(pairs, tilt_before, tilt_now, r_b_c)
    return None if motion is None else -float(np.angle(motion[1]))


def ground_residual(pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray) -> float | None:
    """-> RMS distance of the points of a keyframe from those of the frame, after the best similarity [heights above
    ground]. Otherwise as ``visual_motion``."""
    points = _ground_points(pairs, before, now, r_b_c)
    if points is None:
        return None
    kf, k = (one - one.mean() for one in points)
    return float(np.sqrt(np.mean(np.abs(kf - similarity_ratio(k, kf) * k) ** 2)))


def _ground_motion(
    pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray
) -> tuple[complex, complex] | None:
    """-> displacement, and ratio of the points of the frame to those of the keyframe, as complex numbers east + j north
    in heights above ground."""
    points = _ground_points(pairs, before, now, r_b_c)
    if points is None:
        return None
    kf, k = points
    ratio = _ratio(k, kf)
    return complex(kf.mean() - ratio * k.mean()), ratio


def _ground_points(
    pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """-> where the rays of the keyframe and of the frame, complex (N,), meet the ground, east + j north from each
    camera, in heights."""
    if len(pairs) < MIN_VELOCITY_PAIRS:
        return None
    rays_kf, rays_k = (_rays(pairs[:, i : i + 2], a, r_b_c) for i, a in ((0, before), (2, now)))
    down = (rays_kf[:, 2] < -MIN_RAY_DOWN) & (rays_k[:, 2] < -MIN_RAY_DOWN)
    if int(down.sum()) < MIN_VELOCITY_PAIRS:
        return None
    kf, k = (rays[down, 0] / -rays[down, 2] + 1j * rays[down, 1] / -rays[down, 2] for rays in (rays_kf, rays_k))
    return kf, k


def _ratio(a: np.ndarray, b: np.ndarray) -> complex:
    """Ratio of b = ratio * a + shift, by least squares over complex numbers (N,)."""
    return similarity_ratio(a - a.mean(), b - b.mean())


def _rays(xy: np.ndarray, attitude: Attitude, r_b_c: np.ndarray) -> np.ndarray:
    """World directions (N, 3) of normalised image points (N, 2)."""
    r_w_b = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
    return np.asarray(np.column_stack([xy, np.ones(len(xy))]) @ (r_w_b @ r_b_c).T)
