"""Three keyframes that see the same points: how long one way is in units of the other, whatever the ground is like.

A plane takes the length of every way from a height above ground, which relief changes. Points that three keyframes see
carry it on from one way to the next: a bundle adjustment of three cameras, in which each point is an unknown of its
own. It is done when the third comes, and the points are taken out (Schur's complement; Triggs et al., "Bundle
Adjustment: A Modern Synthesis", 2000, 6). What stays is a factor that is linear in where the two outer cameras are in
the middle one, and that says nothing of how long all of it is."""

from dataclasses import dataclass, replace
from typing import Any

import gtsam
import numpy as np

from terrafix.core.camera import straightened
from terrafix.estimator.factors.custom_factors import BIAS_SIZE, HEIGHT, LENS
from terrafix.estimator.factors.linearization_cache import custom_factor
from terrafix.estimator.models.plane_motion import EFFECTIVE_PAIRS

MIN_TRIPLES = 12
# A wrong focal length is wrong in the same way in every picture: n errors of one sigma add up to n sigmas, not to the
# root of n as independent ones do. n is 25 here: a turn or two, in which it looks like another heading.
FOCAL_REPEATS = 5.0
MIN_WAY = 0.05  # of the height, each of the two: shorter ways tell no depths
SHARED = 3.0  # a picture is in three of these, with the same errors of its points
ROUNDS, CLOSE = 5, 1e-5  # of Gauss-Newton, at most; a step of radians and of heights below which it has ended
HUBER_K = 1.5
MEDIAN_OFF = 0.888  # of points whose three free numbers have a 1-sigma of one: root of a third of chi-square's median
MOST_SIGMA = 4.0  # points that are farther off than that many of the sigmas that their tracker claims are not the same
MOST_BEHIND = 0.1  # share of the points, behind the camera
# 1-sigma of the second radial coefficient, which nobody describes or learns, where only a focal length is known
# (`village-1`: 0.03). Points off one plane would be bent by it.
BEND4_SIGMA = 0.03
# While the points are sought the cameras stay near where they are believed to be (rad; share of the way): what the
# points leave open is not to run away. It says nothing in the factor, but what ends farther away than NEAR_SIGMAS of it
# is no place that the pairs of the same pictures could have overlooked.
NEAR_RAD, NEAR_SHARE, NEAR_SIGMAS = 0.03, 0.1, 3.0
OPEN = 1e-9  # share of the largest eigenvalue below which a direction is open: the scale of all
# Six numbers of each outer camera, and k1; k2 and the focal length, relative, which nobody seeks.
SOUGHT, OTHERS = 13, 2


@dataclass(frozen=True)
class ThreeViewPose:
    """The outer cameras in the middle one, metres, and that one's height above ground at ``ground_m``. ``lens``: what
    the lens bends beyond its description."""

    first: gtsam.Pose3
    last: gtsam.Pose3
    height_m: float
    ground_m: float
    lens: float


@dataclass(frozen=True)
class ThreeViewConstraint:
    """``rows`` (R, SOUGHT) times a twist of both outer cameras of ``at`` and a change of its lens, and ``rest`` (R,),
    whitened."""

    at: ThreeViewPose
    rows: np.ndarray
    rest: np.ndarray


@dataclass(frozen=True)
class _Normal:
    """Normal equations without the points, ``left`` x = -``right``; and how the points (N, 3) follow: ``inner``
    (N, 3, 3), ``cross`` (N, SOUGHT, 3) and ``pull`` (N, 3). ``sigma``: of a coordinate, by what is left of it."""

    left: np.ndarray
    right: np.ndarray
    inner: np.ndarray
    cross: np.ndarray
    pull: np.ndarray
    sigma: float


def three_view_constraint(
    triples: np.ndarray, sigma_norm: float, guess: ThreeViewPose, focal_sigma: float
) -> ThreeViewConstraint | None:
    """``triples`` (N, 6) normalised (first, middle, last), with the 1-sigma of a coordinate; ``focal_sigma``: of the
    focal length, relative. None: they do not tell, or not of what is believed."""
    ways = [float(np.linalg.norm(pose.translation())) for pose in (guess.first, guess.last)]
    if len(triples) < MIN_TRIPLES or min(ways) < MIN_WAY * guess.height_m:
        return None
    straight = straightened(triples.reshape(-1, 2), guess.lens)
    seen = straight.reshape(-1, 3, 2)[:, [1, 0, 2]]  # the middle one comes first
    points = np.column_stack([seen[:, 0], np.full(len(seen), 1.0 / guess.height_m)])  # x, y, 1 / depth in that
    near = np.concatenate([np.full(3, size) for way in ways for size in (NEAR_RAD, NEAR_SHARE * way)])
    unit = np.tile([1.0, 1.0, 1.0, *[guess.height_m] * 3], 2)
    at, away = guess, np.zeros(12)
    for _ in range(ROUNDS):
        normal = _normal(points, seen, at, sigma_norm, focal_sigma)
        held = normal.left[:12, :12] + np.diag(near**-2)  # the lens is not sought here
        step = -np.linalg.solve(held, normal.right[:12] + away / near**2)
        points = points - np.einsum(
            "nij,nj->ni", normal.inner, normal.pull + np.einsum("nij,i->nj", normal.cross[:, :12], step)
        )
        at = replace(at, first=at.first.retract(step[:6]), last=at.last.retract(step[6:]))
        away = np.concatenate([guess.first.logmap(at.first), guess.last.logmap(at.last)])
        if np.abs(step / unit).max() < CLOSE:
            break
    normal = _normal(points, seen, at, sigma_norm, focal_sigma)
    behind = (points[:, 2] <= 0.0).mean() > MOST_BEHIND
    if not np.isfinite(normal.left).all() or behind or normal.sigma > MOST_SIGMA * sigma_norm:
        return None
    if np.abs(away / near).max() > NEAR_SIGMAS:
        return None
    values, vectors = np.linalg.eigh(normal.left)
    keep = values > OPEN * values[-1]
    root = np.sqrt(values[keep])
    return ThreeViewConstraint(at, vectors[:, keep].T * root[:, None], vectors[:, keep].T @ normal.right / root)


def _normal(points: np.ndarray, seen: np.ndarray, at: ThreeViewPose, sigma_norm: float, focal_sigma: float) -> _Normal:
    """What nobody seeks of the lens is taken out like the points: it is open by so much. Of the points no more are
    independent than of pairs: their patches look alike, and what a lens or a shutter bends moves many of them."""
    residual, by_cameras, by_point = projected(points, seen, at)
    off = np.sqrt(np.sum(residual**2, axis=1) / 3.0)  # three of six numbers are the point's
    sigma = float(np.median(off)) / MEDIAN_OFF
    claimed = max(sigma_norm, sigma)
    independent = min(1.0, EFFECTIVE_PAIRS / len(seen)) / SHARED
    weight = np.minimum(1.0, HUBER_K * claimed / np.maximum(off, 1e-12)) * (independent / claimed**2)
    by_point_t = np.swapaxes(by_point * weight[:, None, None], 1, 2)
    inner = np.linalg.inv(by_point_t @ by_point + 1e-12 * np.eye(3))
    cross = np.swapaxes(by_point_t @ by_cameras, 1, 2)
    pull = (by_point_t @ residual[:, :, None])[:, :, 0]
    flat, flat_weight = by_cameras.reshape(-1, SOUGHT + OTHERS), np.repeat(weight, 6)[:, None]
    columns = np.moveaxis(cross, 1, 0).reshape(SOUGHT + OTHERS, -1)
    gain = np.moveaxis(cross @ inner, 1, 0).reshape(SOUGHT + OTHERS, -1)
    whole = (flat * flat_weight).T @ flat - gain @ columns.T
    push = (flat * flat_weight).T @ residual.ravel() - gain @ pull.ravel()
    s = slice(0, SOUGHT)
    open_by = np.diag(np.array([BEND4_SIGMA, FOCAL_REPEATS * focal_sigma]) ** -2.0)
    of_lens = np.linalg.solve(whole[SOUGHT:, SOUGHT:] + open_by, whole[SOUGHT:, s]).T
    left, right = whole[s, s] - of_lens @ whole[SOUGHT:, s], push[s] - of_lens @ push[SOUGHT:]
    return _Normal(left, right, inner, cross[:, s], pull, sigma)


def projected(points: np.ndarray, seen: np.ndarray, at: ThreeViewPose) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """-> residuals (N, 6), Jacobians by cameras and lens (N, 6, SOUGHT + OTHERS), by points (N, 6, 3)."""
    n = len(points)
    residual, by_cameras, by_point = np.zeros((n, 6)), np.zeros((n, 6, SOUGHT + OTHERS)), np.zeros((n, 6, 3))
    ray = np.column_stack([points[:, :2], np.ones(n)])
    for i, pose in enumerate((None, at.first, at.last)):
        r = np.eye(3) if pose is None else pose.rotation().matrix()
        p = np.zeros(3) if pose is None else np.asarray(pose.translation())
        q = (ray - points[:, 2:] * p) @ r  # in that camera, times 1 / depth
        z = np.maximum(q[:, 2], 0.05)
        xy = q[:, :2] / z[:, None]
        r2 = np.sum(xy**2, axis=1, keepdims=True)
        rows = slice(2 * i, 2 * i + 2)
        residual[:, rows] = xy - seen[:, i]
        by_q = np.zeros((n, 2, 3))
        by_q[:, 0, 0] = by_q[:, 1, 1] = 1.0 / z
        by_q[:, :, 2] = -xy / z[:, None]
        if pose is not None:
            own = 6 * (i - 1)
            by_cameras[:, rows, own : own + 3] = by_q @ _cross(q)
            by_cameras[:, rows, own + 3 : own + 6] = -points[:, 2, None, None] * by_q
        by_cameras[:, rows, SOUGHT - 1], by_cameras[:, rows, SOUGHT] = r2 * xy, r2**2 * xy
        by_cameras[:, rows, SOUGHT + 1] = xy
        by_point[:, rows, :2] = by_q @ r.T[:, :2]
        by_point[:, rows, 2] = -by_q @ (r.T @ p)
    return residual, by_cameras, by_point


def _cross(q: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of which times a small turn is what that does to q: q x turn."""
    out = np.zeros((len(q), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -q[:, 2], q[:, 1], -q[:, 0]
    return out - out.transpose(0, 2, 1)


def three_view_factor(
    nodes: tuple[tuple[int, int], tuple[int, int], tuple[int, int]], seen: ThreeViewConstraint, *, rises: bool
) -> gtsam.CustomFactor:
    """``nodes``: keys of C and B of the first, the middle and the last camera. ``rises``: no map tells the ground, so
    that a camera is higher than C says by what B says.

    Ways count in units of the height, as those of pairs do: in metres the same noise would weigh less the lower the
    flight is believed to be, and in units of the first way a node that GTSAM no longer linearises anew, because others
    have left, would bend them. Without a tail: GTSAM weighs that where a factor is linear, up to a metre from the
    estimate, which is many sigmas."""
    poses, biases = [node[0] for node in nodes], [node[1] for node in nodes]
    by_first, by_last, by_lens = seen.rows[:, :6], seen.rows[:, 6:12], seen.rows[:, 12]
    at = seen.at

    def error(_this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        c = [values.atPose3(key) for key in poses]
        bias, up = values.atVector(biases[2]), c[1].rotation().matrix()[2]
        height_m = max(float(c[1].translation()[2]) - at.ground_m, 1.0)
        unit = at.height_m / height_m
        if rises:
            risen = [float(values.atVector(key)[HEIGHT]) for key in biases]
            c = [
                gtsam.Pose3(pose.rotation(), pose.translation() + np.array([0.0, 0.0, m]))
                for pose, m in zip(c, risen, strict=True)
            ]
        ways = c[1].between(c[0]), c[1].between(c[2])
        steps = [gtsam.Pose3(way.rotation(), unit * way.translation()) for way in ways]
        residual = seen.rest + by_first @ at.first.logmap(steps[0]) + by_last @ at.last.logmap(steps[1])
        residual += by_lens * (float(bias[LENS]) - at.lens)
        if jacobians is not None:
            by0, by2 = (np.hstack([by[:, :3], unit * by[:, 3:]]) for by in (by_first, by_last))
            by1 = -by0 @ ways[0].inverse().AdjointMap() - by2 @ ways[1].inverse().AdjointMap()
            by_bias = [np.zeros((len(residual), BIAS_SIZE), order="F") for _ in biases]
            if rises:
                for of_b, by, pose in zip(by_bias, (by0, by1, by2), c, strict=True):
                    of_b[:, HEIGHT] = by[:, 3:] @ pose.rotation().matrix()[2]
            by_bias[2][:, LENS] = by_lens
            longer = sum(
                by[:, 3:] @ way.rotation().unrotate(way.translation()) for by, way in zip((by0, by2), ways, strict=True)
            )
            by1[:, 3:] -= np.outer(longer, up) / height_m
            jacobians[:3] = [np.asfortranarray(by) for by in (by0, by1, by2)]
            jacobians[3:] = by_bias if rises else by_bias[2:]
        return np.asarray(residual)

    noise = gtsam.noiseModel.Unit.Create(len(seen.rows))
    return custom_factor(noise, [*poses, *(biases if rises else biases[2:])], error)
