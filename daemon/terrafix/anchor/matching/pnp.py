"""Camera pose from 2D-3D matches with the map: IPPE inside RANSAC, then robust refinement (ON-1)."""

from dataclasses import dataclass, replace

import cv2
import numpy as np

from terrafix.core.pose import PoseFit, exp_so3, fit_pose, log_so3
from terrafix.messages import Verdict

RANSAC_ITERATIONS = 300
CONFIDENCE = 0.999
THRESHOLD = 0.03  # of the height: relief, leaning buildings and the map's own warps stay below this
MIN_INLIERS = 8
MIN_INLIER_SHARE = 0.35
# Patches that are neighbours share a third of their error, farther ones nothing (docs/monte-carlo.md): with four
# neighbours 1 in 1 + 4/3 is independent.
INDEPENDENT_SHARE = 3 / 7
MAX_TILT_CHANGE_RAD = np.radians(20.0)  # from the prediction; more is the mirror solution of a flat scene
PLANAR_RELIEF = 0.02  # of the height: flatter ground than this is treated as a plane


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
    reach: float,
    least: int = MIN_INLIERS,
) -> PnpResult:
    """``points_w_m`` (N, 3), ``xy`` (N, 2) normalised; ``r_w_c`` predicted. ``threshold`` of an inlier and
    ``reach`` of the search as shares of the height. ``least`` inliers there must be."""
    n = len(xy)
    chance = min(1.0, np.pi * threshold**2 / (2 * reach) ** 2)  # that a patch that was matched at random agrees
    none = np.zeros(n, bool)
    needed = max(least, MIN_INLIER_SHARE * n, n * chance + 4.0 * float(np.sqrt(n * chance)) + 3.0)
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
    return PnpResult(Verdict.ACCEPTED, replace(fit, cov=fit.cov * _by_chance(n, int(inlier.sum()), chance)), inlier)


def _by_chance(matches: int, inliers: int, chance: float) -> float:
    """Factor on the covariance for inliers that are none: of the wrong matches a share of ``chance`` agrees with any
    pose. They say nothing of it, and it leans to where there are most of them: over a background of wrong ones a
    truncated mean of n has the variance that the right ones alone would give, times n over these (Huber 1981, "Robust
    statistics", section 3.2: E psi^2 over (E psi')^2; the background adds to the first and takes from the second)."""
    wrong = (matches - inliers) / (1.0 - chance) * chance
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
    """Twice: on RANSAC's inliers, then on all that agree with that pose."""
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
