"""What a pair of frames says of the motion between them when only the autopilot's attitude levels the picture."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.geodesy import rot_w_b
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.plane_motion import similarity_ratio

LEAST_DOWN = 0.2  # down component of a unit-depth ray that meets the ground no farther than five heights away
LEAST_PAIRS = 8


@dataclass(frozen=True)
class Sighting:
    """``moved`` (2,) east, north, in heights above the ground; ``turned_rad``: by how much the pictures show that the
    camera turned about its optical axis, clockwise, whatever its mount is; ``said_rad``: the same by the attitude."""

    moved: np.ndarray
    turned_rad: float
    said_rad: float


def sighting(pairs: np.ndarray, before: Attitude, now: Attitude, r_b_c: np.ndarray) -> Sighting | None:
    """``pairs`` (N, 4): rays of the keyframe and of this frame, normalised; the attitudes of both; R_b_c (3x3) as it is
    described. None where an attitude has no heading or few rays look down."""
    if before.yaw_rad is None or now.yaw_rad is None or len(pairs) < LEAST_PAIRS:
        return None
    rays_kf, rays_k = (_rays(pairs[:, i : i + 2], a, r_b_c) for i, a in ((0, before), (2, now)))
    down = (rays_kf[:, 2] < -LEAST_DOWN) & (rays_k[:, 2] < -LEAST_DOWN)
    if int(down.sum()) < LEAST_PAIRS:
        return None
    kf, k = (rays[down, 0] / -rays[down, 2] + 1j * rays[down, 1] / -rays[down, 2] for rays in (rays_kf, rays_k))
    moved = complex(kf.mean() - _ratio(k, kf) * k.mean())
    turned = _ratio(pairs[:, 2] + 1j * pairs[:, 3], pairs[:, 0] + 1j * pairs[:, 1])
    said_rad = float(np.remainder(now.yaw_rad - before.yaw_rad + np.pi, 2 * np.pi) - np.pi)
    return Sighting(np.array([moved.real, moved.imag]), float(np.angle(turned)), said_rad)


def _ratio(a: np.ndarray, b: np.ndarray) -> complex:
    """b = ratio * a + shift, by least squares over complex numbers (N,)."""
    return similarity_ratio(a - a.mean(), b - b.mean())


def _rays(xy: np.ndarray, attitude: Attitude, r_b_c: np.ndarray) -> np.ndarray:
    """World directions (N, 3) of normalised image points (N, 2)."""
    r_w_b = rot_w_b(attitude.yaw_rad or 0.0, attitude.pitch_rad or 0.0, attitude.roll_rad or 0.0)
    return np.asarray(np.column_stack([xy, np.ones(len(xy))]) @ (r_w_b @ r_b_c).T)
