"""Camera pose from 2D-3D matches by robust Gauss-Newton (iteratively reweighted least squares), with covariance.

The tangent vector of a pose is (rotation, translation), applied on the right (camera frame), as GTSAM's Pose3."""

import math
from dataclasses import dataclass

import numpy as np

ROTATION, TRANSLATION = slice(0, 3), slice(3, 6)  # of a tangent vector [spec: Pose3 tangent order]
HORIZONTAL = slice(0, 2)  # of a vector in the world [spec: east, north, up]
POSE_HUBER_K = 1.345  # threshold in sigmas: 95 % efficiency on Gaussian noise (Huber 1981)
MAX_ITERATIONS, MAX_CUT_ITERATIONS = 15, 40  # the second with a cutoff, whose weights change with the pose
MAX_CONDITION = 1e9  # condition number of the scaled normal equations; a well-conditioned geometry has less than ten
POSE_STEP_TOLERANCE = 1e-5  # last step [rad, and metres relative to depth]: a hundredth of a pixel, below the noise


@dataclass(frozen=True)
class PoseFit:
    """``r_w_c`` (3x3), ``p_c_in_w_m`` (3,), ``cov`` (6x6, tangent order), ``residuals`` (N,): norm of each
    reprojection error in normalised image units."""

    r_w_c: np.ndarray
    p_c_in_w_m: np.ndarray
    cov: np.ndarray
    residuals: np.ndarray
    sigma: float  # 1-sigma of one image coordinate from the residuals, normalised units; at least ``sigma_floor``


def exp_so3(w: np.ndarray) -> np.ndarray:
    """Exponential map of SO(3) (Rodrigues' formula): rotation vector (3,) [rad] -> matrix (3x3)."""
    x, y, z = w.tolist()
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    a, b = (math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle2) if angle >= 1e-8 else (1.0, 0.0)
    return np.array(
        [
            [1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y],
            [b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x],
            [b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)],
        ]
    )


def log_so3(r: np.ndarray) -> np.ndarray:
    """Logarithm of SO(3): matrix (3x3) -> rotation vector (3,) [rad]. Valid for angles below pi."""
    (a, b, c), (d, e, f), (g, h, i) = r.tolist()
    angle = math.acos(min(1.0, max(-1.0, (a + e + i - 1.0) / 2.0)))
    half = 0.5 if angle < 1e-7 else angle / (2.0 * math.sin(angle))
    return half * np.array([h - f, c - g, d - b])


def small_turns(r_a: np.ndarray, r_b: np.ndarray) -> np.ndarray:
    """(N, 3) rotation [rad] about the axes of the world from ``r_a`` (N, 3, 3) to ``r_b``, to second order."""
    step = np.einsum("nij,nkj->nik", r_b, r_a)
    return 0.5 * np.column_stack([step[:, i, j] - step[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0))])


def project_with_jacobian(
    r_w_c: np.ndarray, p_c_in_w_m: np.ndarray, points_w_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Projects points (N, 3) -> normalised coordinates (N, 2), their Jacobian (N, 2, 6) with respect to the tangent
    vector of the pose, depth (N,) [m]."""
    q = (points_w_m - p_c_in_w_m) @ r_w_c
    z = np.maximum(q[:, 2], 1e-6)
    xy = q[:, :2] / z[:, None]
    # q = R^T (P - p); right perturbation: dq = [q]x w - v. Rows: derivatives of x = q_x / z and y = q_y / z.
    x, y = xy.T
    jacobian = np.zeros((len(q), 2, 6))
    jacobian[:, 0, 0], jacobian[:, 1, 1] = x * y, -x * y
    jacobian[:, 0, 1], jacobian[:, 1, 0] = -(q[:, 2] / z + x * x), q[:, 2] / z + y * y
    jacobian[:, 0, 2], jacobian[:, 1, 2] = y, -x
    jacobian[:, 0, 3] = jacobian[:, 1, 4] = -1.0 / z
    jacobian[:, :, 5] = xy / z[:, None]
    return xy, jacobian, q[:, 2]


def fit_pose(
    points_w_m: np.ndarray,
    xy: np.ndarray,
    r_w_c: np.ndarray,
    p_c_in_w_m: np.ndarray,
    sigma_floor: float,
    weights: np.ndarray | None = None,
    independent_share: float = 1.0,
    tilt_sigma_rad: float | None = None,
    tolerance: float = POSE_STEP_TOLERANCE,
    cutoff: float | None = None,
) -> PoseFit | None:
    """Robust least squares on the reprojection error of points (N, 3) observed at normalised ``xy`` (N, 2).

    ``r_w_c``, ``p_c_in_w_m``: initial pose. ``sigma_floor``: least 1-sigma of an image coordinate, normalised units.
    ``weights`` (N,): extra weight of each match. ``independent_share``: share of the matches that counts as independent
    (neighbouring patches share pixels; relief displaces whole blocks of patches). ``tilt_sigma_rad``: 1-sigma of a
    prior on the tilt of the given ``r_w_c``, needed because matches in a narrow band cannot separate tilt from
    translation; None: no prior. ``tolerance``: size of the last step, rad and metres relative to depth. ``cutoff``:
    reprojection error, normalised, from which a match counts nothing; its weight falls to zero there without a step
    (Beaton and Tukey 1974), so which matches count does not depend on where the iteration began. Returns ``None`` when
    the geometry does not determine a pose."""
    sigma = sigma_floor
    r, p = r_w_c, p_c_in_w_m
    hessian = np.eye(6)
    norm = np.zeros(len(xy))
    scale = np.ones(6)
    for _ in range(MAX_ITERATIONS if cutoff is None else MAX_CUT_ITERATIONS):
        predicted, jacobian, depth = project_with_jacobian(r, p, points_w_m)
        if depth.min() <= 0:
            return None
        error = xy - predicted
        norm = np.sqrt(np.einsum("ni,ni->n", error, error))
        agrees = None if cutoff is None else biweight(norm, cutoff)
        if agrees is not None and weights is not None:
            agrees *= weights
        sigma = max(sigma_floor, _spread(norm, agrees))
        w = np.minimum(1.0, POSE_HUBER_K * sigma / np.maximum(norm, 1e-12))
        if agrees is not None:
            w *= agrees
        elif weights is not None:
            w *= weights
        flat = jacobian.reshape(-1, 6)
        weighted = flat.T * np.repeat(w, 2)
        hessian = weighted @ flat
        gradient = weighted @ error.ravel()
        if tilt_sigma_rad is not None:
            stiffness = sigma**2 / independent_share / tilt_sigma_rad**2
            hessian[[0, 1], [0, 1]] += stiffness
            gradient[:2] -= stiffness * log_so3(r_w_c.T @ r)[:2]
        scale[3:] = len(depth) / float(depth.sum())
        scaled = hessian / scale / scale[:, None]
        eigenvalues = np.linalg.eigvalsh(scaled)
        if not eigenvalues[0] * MAX_CONDITION > eigenvalues[-1]:  # in this form the test also rejects NaN
            return None
        step = np.linalg.solve(scaled, gradient / scale) / scale
        r = r @ exp_so3(step[:3])
        p = p + r @ step[3:]
        if float(np.abs(step * scale).max()) < tolerance:
            break
    cov = sigma**2 / max(independent_share, 1e-6) * np.linalg.inv(hessian)
    return PoseFit(r, p, (cov + cov.T) / 2, norm, sigma)


def biweight(norm: np.ndarray, cutoff: float) -> np.ndarray:
    """Weights (N,) of residual norms (N,): 1 at zero, 0 from ``cutoff`` on (Beaton and Tukey 1974)."""
    return np.asarray(np.square(np.maximum(1.0 - np.square(norm / cutoff), 0.0)))


def _spread(norm: np.ndarray, weights: np.ndarray | None) -> float:
    """1-sigma of one coordinate from residual norms (N,): by their median, or, where matches count by ``weights``, by
    their mean square, which has no step where a match begins to count."""
    if weights is None:
        return _median(norm) / 1.177  # the median of a Rayleigh distribution is 1.177 sigma
    return math.sqrt(0.5 * float(weights @ np.square(norm)) / max(float(weights.sum()), 1e-12))


def _median(values: np.ndarray) -> float:
    """Median. np.median takes ten times as long for arrays of this size."""
    ordered = np.sort(values)
    return 0.5 * float(ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])


def positive_part(symmetric: np.ndarray) -> np.ndarray:
    """``symmetric`` (n, n) with its negative eigenvalues set to zero: a difference of covariances as a covariance."""
    values, axes = np.linalg.eigh(symmetric)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


def tangent_to_world(cov: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
    """Covariance (6x6) in tangent order, camera frame -> (position ENU, rotation about ENU axes), as in messages."""
    a = np.zeros((6, 6))
    a[:3, 3:] = r_w_c
    a[3:, :3] = r_w_c
    return a @ cov @ a.T


def world_to_tangent(cov: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
    """Inverse of ``tangent_to_world``."""
    a = np.zeros((6, 6))
    a[:3, 3:] = r_w_c
    a[3:, :3] = r_w_c
    return a.T @ cov @ a
