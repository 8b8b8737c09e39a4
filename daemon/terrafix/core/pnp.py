"""Camera pose from 2D-3D matches with the map: IPPE (SQPnP over relief) inside RANSAC, then robust refinement (ON-1).

The anchor judges a place by it, the estimator computes the pose that it fuses: the same function of the same numbers.
OpenCV's RANSAC has a fixed seed, so the results are equal."""

from dataclasses import dataclass, replace

import cv2
import msgspec
import numpy as np

from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import PoseFit, exp_so3, fit_pose, log_so3, tangent_to_world
from terrafix.messages import MapMatch, MapPose, PnpInput, PoseMethod, Verdict

RANSAC_ITERATIONS = 300  # most RANSAC iterations [tuned]
CONFIDENCE = 0.999  # RANSAC confidence [tuned]
# inlier threshold as a share of the height: relief, leaning buildings and distortions of the map stay below it [tuned]
INLIER_THRESHOLD = 0.03
# of that threshold, where a match counts nothing: 4.7 of the sigmas that patches have, so that the estimate is as
# precise as least squares to 5 % [spec: biweight, 95 % efficiency]
POSE_CUTOFF = 1.25
SEARCH_RADIUS = 0.08  # search radius of a patch around its expected place, share of the height [tuned]
PNP_MIN_INLIERS = 8  # fewest inliers of a pose [tuned]
MIN_INLIER_SHARE = 0.35  # smallest share of inliers [tuned]
# Effective share of independent patches. Neighbours share a third of their error, patches farther apart nothing; with
# four neighbours 1 in 1 + 4/3 is independent. [measured: docs/monte-carlo.md]
INDEPENDENT_MATCH_SHARE = 3 / 7
# largest angle between pose and prediction; the mirrored solution of a planar scene exceeds it [tuned]
MAX_POSE_TILT_CHANGE_RAD = np.radians(20.0)
PLANAR_RELIEF = 0.02  # share of the height: ground with less relief is treated as a plane [tuned]


@dataclass(frozen=True)
class PnpResult:
    verdict: Verdict
    fit: PoseFit | None
    inliers: np.ndarray  # (N,) bool


def is_planar(points_w_m: np.ndarray, agl_m: float) -> bool:
    """Whether points (N, 3) seen from ``agl_m`` above them are treated as a plane: their heights differ by less than
    ``PLANAR_RELIEF`` of it."""
    return float(np.ptp(points_w_m[:, 2])) < PLANAR_RELIEF * agl_m


def solve(points_w_m: np.ndarray, xy: np.ndarray, weights: np.ndarray, given: PnpInput) -> PnpResult:
    """Pose from ``points_w_m`` (N, 3) and ``xy`` (N, 2) normalised image coordinates, with ``weights`` (N,) of the
    matches in the refinement.

    Required inliers: the largest of ``given.min_inliers``, ``MIN_INLIER_SHARE`` of N, and N p + 4 sqrt(N p) + 3, where
    p is the probability that a randomly matched patch is an inlier. With fewer the verdict is FEW_INLIERS; DEGENERATE
    if the refinement fails, the tilt is more than ``MAX_POSE_TILT_CHANGE_RAD`` from the prediction, or a number is not
    finite; both without a pose. Else ACCEPTED.
    """
    n, none = len(xy), np.zeros(len(xy), bool)
    p_random_inlier = random_inlier_probability(given)
    needed = max(
        given.min_inliers, MIN_INLIER_SHARE * n, n * p_random_inlier + 4.0 * float(np.sqrt(n * p_random_inlier)) + 3.0
    )
    if n < needed:
        return PnpResult(Verdict.FEW_INLIERS, None, none)
    if not all(np.isfinite(values).all() for values in (points_w_m, xy, weights)):
        return PnpResult(Verdict.DEGENERATE, None, none)
    start = _ransac(points_w_m, xy, given)
    if start is None or len(start.index) < needed:
        return PnpResult(Verdict.FEW_INLIERS, None, none)
    fit, inlier = _refine(points_w_m, xy, weights, start, given)
    if fit is None or inlier.sum() < needed:
        return PnpResult(Verdict.FEW_INLIERS if fit else Verdict.DEGENERATE, None, inlier)
    tilt = np.asarray(log_so3(rot_from_quat(given.q_w_c).T @ fit.r_w_c))[:2]
    if float(np.linalg.norm(tilt)) > MAX_POSE_TILT_CHANGE_RAD:
        return PnpResult(Verdict.DEGENERATE, None, inlier)
    cov = fit.cov * outlier_inflation(n, int(inlier.sum()), p_random_inlier)
    return PnpResult(Verdict.ACCEPTED, replace(fit, cov=cov), inlier)


def solved(match: MapMatch) -> MapMatch:
    """``match`` with the pose that its 2D-3D matches give, and those of them that agree with it; without a pose the
    verdict of PnP. A match that the matcher did not accept, or whose pose it has computed itself, is returned as it
    is."""
    if match.pnp is None or match.verdict is not Verdict.ACCEPTED:
        return match
    matches = np.array(match.matches, dtype=float).reshape(-1, 6)
    xy, points_w_m, weights = (np.ascontiguousarray(matches[:, part]) for part in (slice(0, 2), slice(2, 5), 5))
    found = solve(points_w_m, xy, weights, match.pnp)
    return msgspec.structs.replace(
        match,
        verdict=found.verdict,
        inliers=int(found.inliers.sum()),
        matches=[one for one, agrees in zip(match.matches, found.inliers, strict=True) if agrees],
        pnp=None,
        pose=None if found.fit is None else map_pose(found.fit),
    )


def method_of(match: MapMatch) -> PoseMethod:
    """How ``solved`` computes the pose of ``match``."""
    if match.verdict is not Verdict.ACCEPTED or not (match.pose or (match.pnp and match.matches)):
        return PoseMethod.NONE
    if match.pnp is None:
        return PoseMethod.MATCHER
    planar = is_planar(np.array(match.matches, dtype=float).reshape(-1, 6)[:, 2:5], match.pnp.agl_m)
    return PoseMethod.IPPE if planar else PoseMethod.SQPNP


def map_pose(fit: PoseFit) -> MapPose:
    """``fit`` as in messages."""
    p = fit.p_c_in_w_m
    return MapPose(
        p_c_in_w_m=(float(p[0]), float(p[1]), float(p[2])),
        q_w_c=quat_from_rot(fit.r_w_c),
        cov=tuple(float(v) for v in tangent_to_world(fit.cov, fit.r_w_c).ravel()),
    )


@dataclass(frozen=True)
class _Start:
    """Pose of RANSAC, and the indices (M,) of its inliers."""

    r_w_c: np.ndarray
    p_c_in_w_m: np.ndarray
    index: np.ndarray


def _ransac(points_w_m: np.ndarray, xy: np.ndarray, given: PnpInput) -> _Start | None:
    centre = points_w_m.mean(0)
    local = points_w_m - centre
    planar = is_planar(points_w_m, given.agl_m)
    if planar:
        local[:, 2] = 0.0
    ok, rvec, tvec, index = cv2.solvePnPRansac(
        local,
        np.ascontiguousarray(xy),
        np.eye(3),
        np.zeros(4),
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=given.threshold,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_IPPE if planar else cv2.SOLVEPNP_SQPNP,
    )
    if not ok or index is None:
        return None
    r_c_w = exp_so3(np.asarray(rvec).ravel())
    return _Start(r_c_w.T, centre - r_c_w.T @ np.asarray(tvec).ravel(), np.asarray(index).ravel())


def random_inlier_probability(given: PnpInput) -> float:
    """That a randomly matched patch agrees with a pose."""
    return min(1.0, np.pi * given.threshold**2 / (2 * given.search_radius) ** 2)


def outlier_inflation(matches: int, inliers: int, p_random_inlier: float) -> float:
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
    points: np.ndarray, xy: np.ndarray, weights: np.ndarray, start: _Start, given: PnpInput
) -> tuple[PoseFit | None, np.ndarray]:
    """Two refinements: on RANSAC's inliers, then on all matches, each by how well it agrees, to convergence. Which of
    many near equal samples RANSAC has drawn hangs on rounding; the optimum to which they all lead does not."""
    inlier = np.zeros(len(xy), bool)
    inlier[start.index] = True
    first = fit_pose(
        points[inlier],
        xy[inlier],
        start.r_w_c,
        start.p_c_in_w_m,
        given.sigma_floor,
        weights[inlier],
        INDEPENDENT_MATCH_SHARE,
    )
    if first is None:
        return None, inlier
    cutoff = POSE_CUTOFF * given.threshold
    fit = fit_pose(
        points, xy, first.r_w_c, first.p_c_in_w_m, given.sigma_floor, weights, INDEPENDENT_MATCH_SHARE, cutoff=cutoff
    )
    if fit is None:
        return None, inlier
    q = (points - fit.p_c_in_w_m) @ fit.r_w_c
    error = np.linalg.norm(xy - q[:, :2] / np.maximum(q[:, 2:], 1e-6), axis=1)
    inlier = (error < given.threshold) & (q[:, 2] > 0)
    return (fit if inlier.sum() >= PNP_MIN_INLIERS else None), inlier
