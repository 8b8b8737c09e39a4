"""Three-view factor: points seen by three keyframes give the ratio of both translations, whatever the terrain.

Plane-induced motion takes the length of each translation from a height above ground, which relief changes. Points that
three keyframes see transfer the scale from one translation to the next: a bundle adjustment of three cameras, in which
each point is an unknown. It is solved when the third keyframe arrives, and the points are eliminated by the Schur
complement (Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000, 6). The factor is linear in the poses of the
two outer cameras in the middle one, and carries no information about absolute scale."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from terrafix.core.camera import undistort_division
from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.factors.noise import MIN_HEIGHT_M
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS
from terrafix.estimator.state import CALIBRATION_SIZE, HEIGHT, POSE_SIZE, RADIAL_K1, ROTATION, TRANSLATION, UP

MIN_FACTOR_TRIPLES = 12  # points [tuned]
# A focal length error is equal in all images: n errors of one sigma add up to n sigmas, not to the root of n as
# independent ones do. Root of an n of 25: a turn or two, in which it looks like a change of heading. [tuned]
FOCAL_REPEATS = 5.0
MIN_TRANSLATION = 0.05  # least length of both translations, share of the height: shorter ones give no depth [tuned]
SHARED_TRIPLES = 3.0  # constraints that share an image, with the same errors of its points [spec: three views each]
MAX_POINT_ITERATIONS = 5  # of Gauss-Newton [tuned]
POINT_STEP_TOLERANCE = 1e-5  # convergence, rad and heights [tuned]
POINT_HUBER_K = 1.5  # Huber threshold of a point, in sigmas [tuned]
# Median residual of points whose three free numbers have a 1-sigma of one: root of a third of the median of chi-square
# with 3 dof. [spec: chi-square]
MEDIAN_RESIDUAL = 0.888
MAX_RESIDUAL_RATIO = 4.0  # residual sigma over stated sigma, above which the points are not the same [tuned]
MAX_BEHIND = 0.1  # largest share of points behind the camera [tuned]
# 1-sigma of the second radial coefficient, which is neither described nor estimated, where only a focal length is
# known. Points off one plane are distorted by it. `village-1` has 0.03. [tuned]
K2_SIGMA = 0.03
# Prior of the outer cameras during the iteration, rad and share of the translation: it bounds directions that the
# points leave open. It is not part of the factor; a solution beyond PRIOR_GATE_SIGMAS of it contradicts the pairs of
# the same images. [tuned]
PRIOR_RAD, PRIOR_SHARE, PRIOR_GATE_SIGMAS = 0.03, 0.1, 3.0
NULL_EIGENVALUE = 1e-9  # share of the largest eigenvalue, below which a direction is null: absolute scale [tuned]
# Estimated: tangents of both outer cameras, and k1; eliminated: k2 and the relative focal length. [spec: layout]
ESTIMATED, NUISANCE = 13, 2
FIRST, LAST, CAMERAS, K1 = slice(0, 6), slice(6, 12), slice(0, 12), 12  # of the estimated [spec: layout]
K2, FOCAL_COLUMN = 13, 14  # columns of the nuisance parameters [spec: layout]
MIN_DEPTH = 0.05  # of a point in an outer camera, in units of its depth in the middle one [tuned]


@dataclass(frozen=True)
class ThreeViewPose:
    """Outer cameras in the middle one, metres; height of that one above ground of AMSL elevation ``ground_m``; radial
    coefficient."""

    first: gtsam.Pose3
    last: gtsam.Pose3
    height_m: float
    ground_m: float
    k1: float

    @classmethod
    def of(
        cls, cameras: Sequence[tuple[np.ndarray, np.ndarray]], *, height_m: float, ground_m: float, k1: float
    ) -> "ThreeViewPose":
        """``cameras``: R_w_c (3, 3) and p_c_in_w_m (3,) of the first, the middle and the last one."""
        first, middle, last = (gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), p_m) for r_w_c, p_m in cameras)
        return cls(middle.between(first), middle.between(last), height_m, ground_m, k1)


@dataclass(frozen=True)
class ThreeViewConstraint:
    """Whitened linear residual: ``jacobian`` (R, ESTIMATED) by the tangents of both outer cameras of ``at`` and by the
    radial coefficient, and ``constant`` (R,). ``by_focal`` (R,): by the logarithm of the focal length; None: that is
    eliminated."""

    at: ThreeViewPose
    jacobian: np.ndarray
    constant: np.ndarray
    by_focal: np.ndarray | None = None


@dataclass(frozen=True)
class _NormalEquations:
    """Reduced normal equations ``left`` x = -``right`` of the cameras, and the back substitution of the points (N, 3):
    ``inner`` (N, 3, 3), ``cross`` (N, ESTIMATED, 3), ``gradient`` (N, 3). ``sigma``: 1-sigma of a coordinate, from the
    residuals. ``whole``, ``whole_right``: before the nuisance parameters of the lens are eliminated."""

    left: np.ndarray
    right: np.ndarray
    whole: np.ndarray
    whole_right: np.ndarray
    inner: np.ndarray
    cross: np.ndarray
    gradient: np.ndarray
    sigma: float


def three_view_constraint(
    triples: np.ndarray, sigma_norm: float, guess: ThreeViewPose, focal_sigma: float
) -> ThreeViewConstraint | None:
    """``triples`` (N, 6): normalised (first, middle, last), with the 1-sigma of a coordinate; ``focal_sigma``: 1-sigma
    of the focal length, relative. None: too few points, too short translations, or a solution that contradicts
    ``guess``."""
    solution = _solve(triples, sigma_norm, guess, focal_sigma)
    if solution is None:
        return None
    _, at, normal = solution
    jacobian, constant = _square_root(normal.left, normal.right)
    return ThreeViewConstraint(at, jacobian, constant)


def three_view_constraint_of_focal(
    triples: np.ndarray, sigma_norm: float, guess: ThreeViewPose, focal_sigma: float
) -> ThreeViewConstraint | None:
    """``three_view_constraint`` for a graph in which the focal length is a variable: no error of it is in the noise."""
    solution = _solve(triples, sigma_norm, guess, focal_sigma)
    if solution is None:
        return None
    _, at, normal = solution
    kept = [*range(ESTIMATED), FOCAL_COLUMN]
    left, right = _without(normal.whole, normal.whole_right, kept, {K2: K2_SIGMA})
    jacobian, constant = _square_root(left, right)
    return ThreeViewConstraint(at, jacobian[:, :-1], constant, jacobian[:, -1])


def _square_root(left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations ``left`` x = -``right`` -> whitened Jacobian and constant, without the null space."""
    values, vectors = np.linalg.eigh(left)
    keep = values > NULL_EIGENVALUE * values[-1]
    root = np.sqrt(values[keep])
    return vectors[:, keep].T * root[:, None], vectors[:, keep].T @ right / root


def _without(
    left: np.ndarray, right: np.ndarray, kept: list[int], priors: dict[int, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations of ``kept`` columns. ``priors``: the others, each with its 1-sigma, are eliminated."""
    gone = list(priors)
    prior = np.diag(np.array(list(priors.values())) ** -2.0)
    by_gone = np.linalg.solve(left[np.ix_(gone, gone)] + prior, left[np.ix_(gone, kept)]).T
    return left[np.ix_(kept, kept)] - by_gone @ left[np.ix_(gone, kept)], right[kept] - by_gone @ right[gone]


def triangulate(
    triples: np.ndarray, sigma_norm: float, guess: ThreeViewPose, focal_sigma: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """Arguments as of ``three_view_constraint``. -> points (N, 3) in the middle camera, in the unit of length that the
    translations of ``guess`` give, and the relative 1-sigma of the depth of each (N,) by its image errors; points
    behind the camera are left out. None: as there."""
    solution = _solve(triples, sigma_norm, guess, focal_sigma)
    if solution is None:
        return None
    points, _, normal = solution
    points, inner = points[points[:, 2] > 0.0], normal.inner[points[:, 2] > 0.0]
    # The weights count all points of an image as few independent ones; a single one has its own noise only.
    independent = min(1.0, EFFECTIVE_PAIRS / len(triples)) / SHARED_TRIPLES
    relative_sigma = np.sqrt(inner[:, 2, 2] * independent) / points[:, 2]
    return np.column_stack([points[:, :2], np.ones(len(points))]) / points[:, 2:], relative_sigma


def _solve(
    triples: np.ndarray, sigma_norm: float, guess: ThreeViewPose, focal_sigma: float
) -> tuple[np.ndarray, ThreeViewPose, _NormalEquations] | None:
    """-> points (N, 3) as x, y and inverse depth in the middle camera; the cameras; the normal equations there."""
    lengths = [float(np.linalg.norm(pose.translation())) for pose in (guess.first, guess.last)]
    if len(triples) < MIN_FACTOR_TRIPLES or min(lengths) < MIN_TRANSLATION * guess.height_m:
        return None
    undistorted = undistort_division(triples.reshape(-1, 2), guess.k1)
    seen = undistorted.reshape(-1, 3, 2)[:, [1, 0, 2]]  # the middle camera first
    prior_sigmas = np.concatenate([np.full(3, size) for m in lengths for size in (PRIOR_RAD, PRIOR_SHARE * m)])
    points, at, offset = _bundle_adjustment(seen, guess, prior_sigmas, sigma_norm, focal_sigma)
    normal = _normal_equations(points, seen, at, sigma_norm, focal_sigma)
    behind = (points[:, 2] <= 0.0).mean() > MAX_BEHIND
    if not np.isfinite(normal.left).all() or behind or normal.sigma > MAX_RESIDUAL_RATIO * sigma_norm:
        return None
    if np.abs(offset / prior_sigmas).max() > PRIOR_GATE_SIGMAS:
        return None
    return points, at, normal


def _bundle_adjustment(
    seen: np.ndarray, guess: ThreeViewPose, prior_sigmas: np.ndarray, sigma_norm: float, focal_sigma: float
) -> tuple[np.ndarray, ThreeViewPose, np.ndarray]:
    """Gauss-Newton from ``guess``. ``seen`` (N, 3, 2), the middle camera first; ``prior_sigmas`` (12,) of the tangents.
    -> points (N, 3) as x, y and inverse depth in the middle camera; the cameras; their tangent (12,) from ``guess``."""
    points = np.column_stack([seen[:, 0], np.full(len(seen), 1.0 / guess.height_m)])
    unit = np.tile([1.0, 1.0, 1.0, *[guess.height_m] * 3], 2)
    at, offset = guess, np.zeros(12)
    for _ in range(MAX_POINT_ITERATIONS):
        normal = _normal_equations(points, seen, at, sigma_norm, focal_sigma)
        information = normal.left[CAMERAS, CAMERAS] + np.diag(prior_sigmas**-2)  # the radial coefficient is fixed here
        step = -np.linalg.solve(information, normal.right[CAMERAS] + offset / prior_sigmas**2)
        points = points - np.einsum(
            "nij,nj->ni", normal.inner, normal.gradient + np.einsum("nij,i->nj", normal.cross[:, CAMERAS], step)
        )
        at = replace(at, first=at.first.retract(step[FIRST]), last=at.last.retract(step[LAST]))
        offset = np.concatenate([guess.first.logmap(at.first), guess.last.logmap(at.last)])
        if np.abs(step / unit).max() < POINT_STEP_TOLERANCE:
            break
    return points, at, offset


def _normal_equations(
    points: np.ndarray, seen: np.ndarray, at: ThreeViewPose, sigma_norm: float, focal_sigma: float
) -> _NormalEquations:
    """The nuisance parameters of the lens are eliminated like the points, with their priors. As many points count as
    independent as of pairs: their patches look alike, and a lens or shutter error moves many of them."""
    residual, by_cameras, by_point = project_triples(points, seen, at)
    size = np.sqrt(np.sum(residual**2, axis=1) / 3.0)  # three of six numbers are the point's
    sigma = float(np.median(size)) / MEDIAN_RESIDUAL
    stated = max(sigma_norm, sigma)
    independent = min(1.0, EFFECTIVE_PAIRS / len(seen)) / SHARED_TRIPLES
    weight = np.minimum(1.0, POINT_HUBER_K * stated / np.maximum(size, 1e-12)) * (independent / stated**2)
    by_point_t = np.swapaxes(by_point * weight[:, None, None], 1, 2)
    inner = np.linalg.inv(by_point_t @ by_point + 1e-12 * np.eye(3))
    cross = np.swapaxes(by_point_t @ by_cameras, 1, 2)
    gradient = (by_point_t @ residual[:, :, None])[:, :, 0]
    flat, flat_weight = by_cameras.reshape(-1, ESTIMATED + NUISANCE), np.repeat(weight, 6)[:, None]
    columns = np.moveaxis(cross, 1, 0).reshape(ESTIMATED + NUISANCE, -1)
    gain = np.moveaxis(cross @ inner, 1, 0).reshape(ESTIMATED + NUISANCE, -1)
    schur = (flat * flat_weight).T @ flat - gain @ columns.T
    rhs = (flat * flat_weight).T @ residual.ravel() - gain @ gradient.ravel()
    priors = {K2: K2_SIGMA, FOCAL_COLUMN: FOCAL_REPEATS * focal_sigma}
    left, right = _without(schur, rhs, list(range(ESTIMATED)), priors)
    return _NormalEquations(left, right, schur, rhs, inner, cross[:, :ESTIMATED], gradient, sigma)


def project_triples(
    points: np.ndarray, seen: np.ndarray, at: ThreeViewPose
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``points`` (N, 3): x, y and inverse depth in the middle camera; ``seen`` (N, 3, 2), the middle camera first.
    -> residuals (N, 6), Jacobians by cameras and lens (N, 6, ESTIMATED + NUISANCE), by points (N, 6, 3)."""
    n = len(points)
    residual, by_cameras, by_point = np.zeros((n, 6)), np.zeros((n, 6, ESTIMATED + NUISANCE)), np.zeros((n, 6, 3))
    ray = np.column_stack([points[:, :2], np.ones(n)])
    for i, pose in enumerate((None, at.first, at.last)):
        r = np.eye(3) if pose is None else pose.rotation().matrix()
        p = np.zeros(3) if pose is None else np.asarray(pose.translation())
        q = (ray - points[:, 2:] * p) @ r  # in that camera, times the inverse depth
        z = np.maximum(q[:, 2], MIN_DEPTH)
        xy = q[:, :2] / z[:, None]
        r2 = np.sum(xy**2, axis=1, keepdims=True)
        rows = slice(2 * i, 2 * i + 2)
        residual[:, rows] = xy - seen[:, i]
        by_q = np.zeros((n, 2, 3))
        by_q[:, 0, 0] = by_q[:, 1, 1] = 1.0 / z
        by_q[:, :, 2] = -xy / z[:, None]
        if pose is not None:
            own = POSE_SIZE * (i - 1)
            by_cameras[:, rows, own : own + 3] = by_q @ _cross(q)
            by_cameras[:, rows, own + 3 : own + POSE_SIZE] = -points[:, 2, None, None] * by_q
        by_cameras[:, rows, K1], by_cameras[:, rows, K2] = r2 * xy, r2**2 * xy
        by_cameras[:, rows, FOCAL_COLUMN] = xy
        by_point[:, rows, :2] = by_q @ r.T[:, :2]
        by_point[:, rows, 2] = -by_q @ (r.T @ p)
    return residual, by_cameras, by_point


def _cross(q: np.ndarray) -> np.ndarray:
    """(N, 3, 3) cross product matrices: q x turn, for a small turn."""
    out = np.zeros((len(q), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -q[:, 2], q[:, 1], -q[:, 0]
    return out - out.transpose(0, 2, 1)


def three_view_factor(
    nodes: tuple[tuple[int, int], tuple[int, int], tuple[int, int]],
    constraint: ThreeViewConstraint,
    *,
    rises: bool,
    focal: FocalKey | None = None,
) -> gtsam.CustomFactor:
    """``nodes``: keys of C and B of the first, the middle and the last camera. ``rises``: without a DEM, so that the
    height bias B adds to the height of C. ``focal``: where the focal length is a variable
    (``three_view_constraint_of_focal``).

    Translations are in units of the height, as in plane_two_view_factor. In metres the same noise would weigh less the
    lower the flight is believed to be. In units of the first translation they would be distorted by a node that GTSAM
    does not relinearise because others have left. The loss is quadratic: GTSAM computes a robust weight at the
    linearization point, up to a metre from the estimate, which is many sigmas."""
    poses, biases = [node[0] for node in nodes], [node[1] for node in nodes]
    jacobian, at = constraint.jacobian, constraint.at
    by_first, by_last, by_k1 = jacobian[:, FIRST], jacobian[:, LAST], jacobian[:, K1]

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c = [values.atPose3(key) for key in poses]
        bias, up = values.atVector(biases[2]), c[1].rotation().matrix()[UP]
        height_m = max(float(c[1].translation()[UP]) - at.ground_m, MIN_HEIGHT_M)
        scale = at.height_m / height_m
        if rises:
            rise_m = [float(values.atVector(key)[HEIGHT]) for key in biases]
            c = [
                gtsam.Pose3(pose.rotation(), pose.translation() + np.array([0.0, 0.0, m]))
                for pose, m in zip(c, rise_m, strict=True)
            ]
        outer = c[1].between(c[0]), c[1].between(c[2])
        first, last = (gtsam.Pose3(pose.rotation(), scale * pose.translation()) for pose in outer)
        residual = constraint.constant + by_first @ at.first.logmap(first) + by_last @ at.last.logmap(last)
        residual += by_k1 * (float(bias[RADIAL_K1]) - at.k1)
        if focal is not None and constraint.by_focal is not None:
            residual += constraint.by_focal * (float(values.atVector(focal.key)[0]) - focal.at)
        if jacobians is not None:
            by_0, by_2 = (np.hstack([by[:, ROTATION], scale * by[:, TRANSLATION]]) for by in (by_first, by_last))
            by_1 = -by_0 @ outer[0].inverse().AdjointMap() - by_2 @ outer[1].inverse().AdjointMap()
            by_bias = [np.zeros((len(residual), CALIBRATION_SIZE), order="F") for _ in biases]
            if rises:
                for of_b, by, pose in zip(by_bias, (by_0, by_1, by_2), c, strict=True):
                    of_b[:, HEIGHT] = by[:, TRANSLATION] @ pose.rotation().matrix()[UP]
            by_bias[2][:, RADIAL_K1] = by_k1
            by_scale = sum(
                by[:, TRANSLATION] @ pose.rotation().unrotate(pose.translation())
                for by, pose in zip((by_0, by_2), outer, strict=True)
            )
            by_1[:, TRANSLATION] -= np.outer(by_scale, up) / height_m
            jacobians[:3] = [np.asfortranarray(by) for by in (by_0, by_1, by_2)]
            jacobians[3 : 6 if rises else 4] = by_bias if rises else by_bias[2:]
            if focal is not None and constraint.by_focal is not None:
                jacobians[-1] = np.asfortranarray(constraint.by_focal[:, None])
        return np.asarray(residual)

    noise = gtsam.noiseModel.Unit.Create(len(jacobian))
    keys = [*poses, *(biases if rises else biases[2:])]
    return custom_factor(noise, keys if focal is None else [*keys, focal.key], error)
