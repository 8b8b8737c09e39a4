"""Increments of velocity and position from specific force and attitude: what estimator and link have in common.

Both follow the same steps: a gap rule, rotation into the world by the autopilot's attitude, gravity removed,
integration. They differ in what is known when: the estimator has attitudes on both sides of every reading and
interpolates (``rotate_to_world``, ``trapezoid_weights``), the link predicts to the present and holds the last value
(``integrate_held``). Largest gaps are arguments. Reasons: docs/decisions/036-inertial-integration.md."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

GRAVITY_MPS2 = 9.81  # of specific force and of banked turns


def covers(t_ns: Sequence[int] | np.ndarray, t0_ns: int, t1_ns: int, max_gap_ns: int) -> bool:
    """Whether measurements at ``t_ns`` (N,), in order, cover ``t0_ns`` to ``t1_ns``: neither between two nor from an
    end of the interval to the nearest is more than ``max_gap_ns``."""
    if len(t_ns) == 0 or t_ns[0] > t0_ns + max_gap_ns or t_ns[-1] < t1_ns - max_gap_ns:
        return False
    return bool(np.diff(t_ns).max(initial=0) <= max_gap_ns)


def rotate_to_world(v_b: Sequence[np.ndarray], yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Three axes (N,) of body FRD -> (N, 3) in world ENU; ``geodesy.rot_w_b`` for many at once."""
    (cy, sy), (cp, sp), (cr, sr) = ((np.cos(a), np.sin(a)) for a in (yaw, pitch, roll))
    x, y, z = v_b
    ahead = cp * x + sp * (sr * y + cr * z)  # level axes of the heading: forward, right
    right = cr * y - sr * z
    down = -sp * x + cp * (sr * y + cr * z)
    return np.column_stack([sy * ahead + cy * right, cy * ahead - sy * right, -down])


def integrated(values: np.ndarray, s_s: np.ndarray) -> np.ndarray:
    """Integral of ``values`` (N, ...) at ``s_s`` (N,) [s] from the first to each, linear between them: same shape."""
    spans_s = np.diff(s_s).reshape(-1, *[1] * (values.ndim - 1))
    return np.concatenate([np.zeros_like(values[:1]), np.cumsum(0.5 * (values[1:] + values[:-1]) * spans_s, axis=0)])


def trapezoid_weights(s_s: np.ndarray) -> np.ndarray:
    """(N,) [s]: weights with which values at ``s_s`` (N,) are summed to their integral, linear between them."""
    weight = np.zeros(len(s_s))
    weight[1:] += 0.5 * np.diff(s_s)
    weight[:-1] += 0.5 * np.diff(s_s)
    return weight


def integrate_held(
    t_ns: Sequence[int], accel_w_mps2: Sequence[Sequence[float]], t0_ns: int, t1_ns: int
) -> tuple[np.ndarray, np.ndarray]:
    """-> (velocity increment (3,) [m/s], position increment (3,) that it causes [m]) from ``t0_ns`` to ``t1_ns``.

    The acceleration is piecewise constant: each of ``accel_w_mps2`` (N, 3) holds between the midpoints to its
    neighbours, the first from ``t0_ns``, the last to ``t1_ns``."""
    midpoints = [(a + b) // 2 for a, b in pairwise(t_ns)]
    delta_v, delta_p = np.zeros(3), np.zeros(3)
    for begin, end, value in zip([t0_ns, *midpoints], [*midpoints, t1_ns], accel_w_mps2, strict=True):
        dt_s = (min(max(end, t0_ns), t1_ns) - min(max(begin, t0_ns), t1_ns)) * 1e-9
        accel = np.array(value)
        delta_p += delta_v * dt_s + 0.5 * accel * dt_s**2
        delta_v += accel * dt_s
    return delta_v, delta_p
