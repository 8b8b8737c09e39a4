"""Camera pose from 2D-3D matches with the map: IPPE (SQPnP over relief) inside RANSAC, then robust refinement
(ON-1)."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from terrafix.core.pose import PoseFit, exp_so3, fit_pose, log_so3
from terrafix.messages import Verdict

RANSAC_ITERATIONS = 300  # most RANSAC iterations [tuned]
CONFIDENCE = 0.999  # RANSAC confidence [tuned]
# inlier threshold as a share of the height: relief, leaning buildings and distortions of the map stay below it [tuned]
INLIER_THRESHOLD = 0.03
MIN_INLIERS = 8  # fewest inliers of a pose [tuned]
MIN_INLIER_SHARE = 0.35  # smallest share of inliers [tuned]
# Effective share of independent patches. Neighbours share a third of their error, patches farther apart nothing; with
# four neighbours 1 in 1 + 4/3 is independent. [measured: docs/monte-carlo.md]
INDEPENDENT_SHARE = 3 / 7
# largest angle between pose and prediction; the mirrored solution of a planar scene exceeds it [tuned]
MAX_TILT_CHANGE_RAD = np.radians(20.0)
PLANAR_RELIEF = 0.02  # share of the height: ground with less relief is treated as a plane [tuned]


@dataclass(frozen=True)
class PnpResult:
    verdict: Verdict
    fit: PoseFit | None
    inliers: np.ndarray  # (N,) bool


def solve(
    points_w_m: np.ndarray,
    xy: np.ndarray,
    weights: np.ndarray,
    r_w_c: np.ndarray,
    agl_m: float,
    sigma_floor: float,
    threshold: float,
    search_radius: float,
    min_inliers: int = MIN_INLIERS,
) -> PnpResult:
    """Pose from ``points_w_m`` (N, 3) and ``xy`` (N, 2) normalised image coordinates, with ``weights`` (N,) of the
    matches in the refinement. ``r_w_c`` (3, 3): predicted rotation. ``agl_m``: height above ground; relief below
    ``PLANAR_RELIEF`` of it counts as a plane. ``sigma_floor``: smallest 1-sigma of a match, normalised image
    coordinates. ``threshold`` of an inlier and ``search_radius`` of the patches: shares of the height.

    Required inliers: the largest of ``min_inliers``, ``MIN_INLIER_SHARE`` of N, and N p + 4 sqrt(N p) + 3, where p is
    the probability that a randomly matched patch is an inlier. With fewer the verdict is FEW_INLIERS; DEGENERATE if the
    refinement fails or the tilt is more than ``MAX_TILT_CHANGE_RAD`` from the prediction; both without a pose. Else
    ACCEPTED.
    """
    n = len(xy)
    p_random_inlier = min(
        1.0, np.pi * threshold**2 / (2 * search_radius) ** 2
    )  # probability that a randomly matched patch is an inlier
    none = np.zeros(n, bool)
    needed = max(
        min_inliers, MIN_INLIER_SHARE * n, n * p_random_inlier + 4.0 * float(np.sqrt(n * p_random_inlier)) + 3.0
    )
    if n < needed:
        return PnpResult(Verdict.FEW_INLIERS, None, none)
    centre = points_w_m.mean(0)
    local = points_w_m - centre
    flat = float(np.ptp(local[:, 2])) < PLANAR_RELIEF * agl_m
    if flat:
        local[:, 2] = 0.0
    ok, rvec, tvec, index = cv2.solvePnPRansac(
        local,
        np.ascontiguousarray(xy),
        np.eye(3),
        np.zeros(4),
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=threshold,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP,
    )
    if not ok or index is None or len(index) < needed:
        return PnpResult(Verdict.FEW_INLIERS, None, none)
    r_c_w = exp_so3(np.asarray(rvec).ravel())
    p = centre - r_c_w.T @ np.asarray(tvec).ravel()
    fit, inlier = _refine(points_w_m, xy, weights, r_c_w.T, p, np.asarray(index).ravel(), sigma_floor, threshold)
    if fit is None or inlier.sum() < needed:
        return PnpResult(Verdict.FEW_INLIERS if fit else Verdict.DEGENERATE, None, inlier)
    tilt = np.asarray(log_so3(r_w_c.T @ fit.r_w_c))[:2]
    if float(np.linalg.norm(tilt)) > MAX_TILT_CHANGE_RAD:
        return PnpResult(Verdict.DEGENERATE, None, inlier)
    return PnpResult(
        Verdict.ACCEPTED, replace(fit, cov=fit.cov * _outlier_inflation(n, int(inlier.sum()), p_random_inlier)), inlier
    )


def _outlier_inflation(matches: int, inliers: int, p_random_inlier: float) -> float:
    """Factor on the covariance for false inliers: of the wrong matches a share ``p_random_inlier`` agrees with any
    pose.

    They carry no information, and the estimate is biased towards them. With uniform outliers in the background, a
    truncated mean of n values has the variance of the true inliers alone times n over their number (Huber 1981, "Robust
    statistics", section 3.2: E psi^2 over (E psi')^2; the background adds to the first and subtracts from the second).
    The factor is the square of that ratio.
    """
    wrong = (matches - inliers) / (1.0 - p_random_inlier) * p_random_inlier
    return float(inliers / max(inliers - wrong, 1.0)) ** 2


def _refine(
    points: np.ndarray,
    xy: np.ndarray,
    weights: np.ndarray,
    r_w_c: np.ndarray,
    p: np.ndarray,
    index: np.ndarray,
    sigma_floor: float,
    threshold: float,
) -> tuple[PoseFit | None, np.ndarray]:
    """Two refinements: on RANSAC's inliers, then on all matches that agree with the first result."""
    inlier = np.zeros(len(xy), bool)
    inlier[index] = True
    fit: PoseFit | None = None
    for _ in range(2):
        fit = fit_pose(points[inlier], xy[inlier], r_w_c, p, sigma_floor, weights[inlier], INDEPENDENT_SHARE)
        if fit is None:
            return None, inlier
        r_w_c, p = fit.r_w_c, fit.p_c_in_w_m
        q = (points - p) @ r_w_c
        error = np.linalg.norm(xy - q[:, :2] / np.maximum(q[:, 2:], 1e-6), axis=1)
        inlier = (error < threshold) & (q[:, 2] > 0)
        if inlier.sum() < MIN_INLIERS:
            return None, inlier
    return fit, inlier
