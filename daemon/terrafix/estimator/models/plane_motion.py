"""Metric camera motion between two frames, from matched rays and the height above the ground plane."""

from dataclasses import KW_ONLY, dataclass, replace

import gtsam
import numpy as np

from terrafix.core.camera import undistort_division
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import fit_pose, log_so3
from terrafix.estimator.state import HORIZONTAL, ROTATION, TRANSLATION, UP

EFFECTIVE_PAIRS = 16.0  # most independent matches: relief moves whole blocks of matches together [tuned]
# 1-sigma of the mean ground level, share of the height, beyond the height's own error: houses and trees. [tuned]
LEVEL_SCALE_SIGMA = 0.02
ROOF_SCALE_SIGMA = 0.12  # ... further, where hardly any match lies on the plane: tall buildings seen from 100 m [tuned]
MIN_MOTION_PAIRS = 8  # matches [tuned]
FIRST_TOLERANCE = 1e-3  # convergence, rad and relative metres: the graph solves again, from the same rays [tuned]
# Largest tilt change beyond the guess: matches in a narrow band confuse translation and tilt, and a wrong tilt rarely
# fits. A motion that fits as well as the matches allow may have a larger change where tilt is not reported: a vehicle
# leans into a turn. [tuned]
MAX_MOTION_TILT_CHANGE_RAD = np.radians(15.0)
TILT_SIGMAS = 5.2  # of the difference of two tilts of equal sigma [spec: root of twice the chi-square, 2 dof, 99.9 %]
GOOD_FIT = 1.3  # residual sigma over stated sigma: three sigmas of the median of 48 [spec: order statistics]
MAX_RAY_UP = -0.2  # up component of a unit-depth ray: the ground lies within five heights [tuned]


@dataclass(frozen=True)
class MatchedRays:
    """``pairs`` (N, 4): matched rays, normalised (keyframe x, y, camera x, y), undistorted by radial coefficient
    ``k1``; ``sigma``: 1-sigma of a coordinate, enlarged for correlated matches; ``ground``: their plane."""

    pairs: np.ndarray
    sigma: float
    ground: "Ground"
    k1: float = 0.0

    def sharing(self, count: int) -> "MatchedRays":
        """One of ``count`` measurements whose errors are correlated, by how much is not known: all of them are roofs
        and trees of the same ground. Each has its share of the information (covariance intersection, Julier and
        Uhlmann 1997), so that all together claim no more than the errors allow."""
        factor, ground = float(np.sqrt(count)), self.ground
        shared = replace(
            ground,
            slope_sigma=factor * ground.slope_sigma,
            curvature_sigma=factor * ground.curvature_sigma,
            level_share=factor * ground.level_sigma_m / ground.height_m,
            share=1.0,  # the level contains it
        )
        return replace(self, sigma=factor * self.sigma, ground=shared)


@dataclass(frozen=True)
class RelativePose:
    """Camera in the keyframe: ``r`` (3x3), ``p_m`` (3,), ``cov`` (6, 6), tangent order. ``rays``: the measurement; None
    for a prediction."""

    r: np.ndarray
    p_m: np.ndarray
    cov: np.ndarray
    rays: "MatchedRays | None" = None

    @property
    def between(self) -> gtsam.Pose3:
        """The same for GTSAM, whose rotations are orthonormal to rounding."""
        return gtsam.Pose3(gtsam.Rot3.ClosestTo(self.r), self.p_m)


@dataclass(frozen=True)
class Ground:
    """Plane under the keyframe: distance straight down, and slope towards east and north.

    ``level_share``: 1-sigma of the mean level, share of the height. ``curvature_sigma``: 1-sigma of its curvature in
    any direction, 1/m. ``rise_sigma_m``: 1-sigma of the change of elevation from below the keyframe to below the other
    camera, without a DEM. ``share`` of the matches that agreed: a plane that few matches support may be a roof."""

    height_m: float
    height_sigma_m: float
    _: KW_ONLY
    slope_e: float = 0.0
    slope_n: float = 0.0
    slope_sigma: float = 0.0
    level_share: float = LEVEL_SCALE_SIGMA
    curvature_sigma: float = 0.0
    rise_sigma_m: float = 0.0
    share: float = 1.0

    @property
    def level_sigma_m(self) -> float:
        """1-sigma of the level of the plane, beyond the error of the height."""
        return (self.level_share + ROOF_SCALE_SIGMA * (1.0 - self.share) ** 2) * self.height_m

    @property
    def translation_scale_sigma(self) -> float:
        """1-sigma of a translation over the plane, as a share of it."""
        return float(np.hypot(self.height_sigma_m, self.level_sigma_m)) / self.height_m


def relative_pose(
    pairs: np.ndarray,
    sigma_norm: float,
    r_w_kf: np.ndarray,
    r_w_k: np.ndarray,
    tilt_sigma_rad: float,
    ground: Ground,
    k1: float = 0.0,
) -> RelativePose | None:
    """``pairs`` (N, 4): normalised (x_kf, y_kf, x, y), distorted by radial coefficient ``k1``, with 1-sigma
    ``sigma_norm``; ``r_w_kf`` and ``ground`` give the plane; ``r_w_k`` is a first guess of the camera, whose tilt is
    known to ``tilt_sigma_rad``, because a plane seen from two places has a mirror solution. None: the matches do not
    determine the motion."""
    if len(pairs) < MIN_MOTION_PAIRS:
        return None
    pairs = np.hstack([undistort_division(pairs[:, :2], k1), undistort_division(pairs[:, 2:], k1)])
    rays_w = np.column_stack([pairs[:, :2], np.ones(len(pairs))]) @ r_w_kf.T
    rays_k = np.column_stack([pairs[:, 2:], np.ones(len(pairs))]) @ r_w_k.T
    downward = (rays_w[:, UP] < MAX_RAY_UP) & (rays_k[:, UP] < MAX_RAY_UP)
    if downward.sum() < MIN_MOTION_PAIRS:
        return None
    slope = np.array([ground.slope_e, ground.slope_n])
    height_m = ground.height_m
    depth = height_m / np.maximum(rays_w[downward, HORIZONTAL] @ slope - rays_w[downward, UP], -MAX_RAY_UP / 2)
    points = rays_w[downward] * depth[:, None]  # world axes, origin at the keyframe
    offsets = rays_k[downward, :2] / -rays_k[downward, 2:] * height_m
    turn, scale, shift = _similarity(offsets, points[:, :2])
    start = np.array([*shift, height_m * (scale - 1.0)])
    effective = min(1.0, EFFECTIVE_PAIRS / len(points))
    fit = fit_pose(
        points,
        pairs[downward, 2:],
        turn @ r_w_k,
        start,
        sigma_norm,
        independent_share=effective,
        tilt_sigma_rad=tilt_sigma_rad,
        tolerance=FIRST_TOLERANCE,
    )
    if fit is None:
        return None
    tilt_change_rad = float(np.linalg.norm(log_so3((turn @ r_w_k).T @ fit.r_w_c)[:2]))
    allowed_rad = TILT_SIGMAS * tilt_sigma_rad if fit.sigma < GOOD_FIT * sigma_norm else 0.0
    if tilt_change_rad > max(MAX_MOTION_TILT_CHANGE_RAD, allowed_rad):
        return None
    cov = fit.cov.copy()
    # An error of the height scales the translation. The tangent's translation is in the axes of the new camera.
    t_new = fit.r_w_c.T @ fit.p_c_in_w_m
    cov[TRANSLATION, TRANSLATION] += np.outer(t_new, t_new) * ground.translation_scale_sigma**2
    up = fit.r_w_c[UP]
    cov[TRANSLATION, TRANSLATION] += ground.rise_sigma_m**2 * np.outer(up, up)
    # An error of the slope rotates the camera by about that slope times translation over height.
    cov[ROTATION, ROTATION] += (ground.slope_sigma * float(np.linalg.norm(t_new)) / height_m) ** 2 * np.eye(3)
    used = MatchedRays(pairs[downward], fit.sigma / float(np.sqrt(effective)), ground, k1)
    return RelativePose(r_w_kf.T @ fit.r_w_c, r_w_kf.T @ fit.p_c_in_w_m, cov, used)


def similarity_ratio(a: np.ndarray, b: np.ndarray) -> complex:
    """b = ratio * a by least squares over complex numbers (N,) of zero mean: scale and rotation (Umeyama 1991)."""
    return complex(np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-12))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """b = scale * turn * a + shift in the plane, by least squares (Umeyama 1991). -> turn (3x3), scale, shift."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    za, zb = (a - mean_a) @ (1, 1j), (b - mean_b) @ (1, 1j)
    ratio = similarity_ratio(za, zb)
    turn = local_rotation_up(float(np.angle(ratio)))
    scale = abs(ratio)
    return turn, scale, mean_b - scale * turn[:2, :2] @ mean_a
