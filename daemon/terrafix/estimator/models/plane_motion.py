"""Metric camera motion between two frames, from matched rays and the height above the ground."""

from dataclasses import KW_ONLY, dataclass

import numpy as np

from terrafix.core.camera import straightened
from terrafix.core.geodesy import local_rotation_up
from terrafix.core.pose import fit_pose, log_so3

EFFECTIVE_PAIRS = 16.0  # relief moves whole blocks of matches together: never more independent ones than this
SCALE_SIGMA = 0.02  # houses and trees lift the mean ground by this share of the height, beyond the height's own error
ROOF_SCALE_SIGMA = 0.12  # ... and by this when hardly any match lies on the plane: tall buildings at 100 m
MIN_PAIRS = 8
FIRST_TOLERANCE = 1e-3  # rad and relative metres; the graph solves for the motion again, from the same rays
# Beyond the guess: matches in a narrow band trade translation for tilt, and a wrong tilt rarely fits. One that fits as
# well as the matches are good may be larger where nobody reports tilt: a vehicle leans into a turn.
MAX_TILT_CHANGE_RAD = np.radians(15.0)
TILT_SIGMAS = 5.2  # chi-square, 2 degrees of freedom, 99.9 %, of the difference of two leans that are known as well
FITS = 1.3  # of the sigma that matches claim: three sigmas of the median of 48
MIN_DOWN = -0.2  # up component of a unit-depth ray that meets the ground no farther than five heights away


@dataclass(frozen=True)
class Seen:
    """Matched rays (N, 4), the 1-sigma of a coordinate with all that makes them less independent, their plane, and
    what of a lens they were straightened by."""

    pairs: np.ndarray
    sigma: float
    ground: "Ground"
    lens: float = 0.0


@dataclass(frozen=True)
class RelativePose:
    """Camera k in the camera of the keyframe: ``r`` (3x3), ``p_m`` (3,), ``cov`` 6x6 (tangent order)."""

    r: np.ndarray
    p_m: np.ndarray
    cov: np.ndarray
    seen: "Seen | None" = None  # what it was computed from; None: a guess


@dataclass(frozen=True)
class Ground:
    """The plane under the keyframe: its distance straight down, and its slope towards east and north."""

    height_m: float
    height_sigma_m: float
    _: KW_ONLY
    slope_e: float = 0.0
    slope_n: float = 0.0
    slope_sigma: float = 0.0
    level_share: float = SCALE_SIGMA  # 1-sigma of the mean plane, share of the height
    bend_sigma: float = 0.0  # 1-sigma of its curvature in any direction, 1/m: how far it may be from being a plane
    rise_sigma_m: float = 0.0  # from the ground below the keyframe to that below the other camera, where nobody tells
    share: float = 1.0  # of the matches that agreed: a plane that few share may be a roof instead of the ground

    @property
    def level_sigma_m(self) -> float:
        """Of the plane, beyond what is wrong with the height itself."""
        return (self.level_share + ROOF_SCALE_SIGMA * (1.0 - self.share) ** 2) * self.height_m

    @property
    def stretch_sigma(self) -> float:
        """Of a way over it, a share of that."""
        return float(np.hypot(self.height_sigma_m, self.level_sigma_m)) / self.height_m


def relative_pose(
    pairs: np.ndarray,
    sigma_norm: float,
    r_w_kf: np.ndarray,
    r_w_k: np.ndarray,
    tilt_sigma_rad: float,
    ground: Ground,
    lens: float = 0.0,
) -> RelativePose | None:
    """``pairs`` (N, 4) normalised (x_kf, y_kf, x, y), as a lens that bends by ``lens`` shows them; ``r_w_kf`` and
    ``ground`` give the plane that is seen; ``r_w_k`` is a first guess of the new camera, whose tilt is known to
    ``tilt_sigma_rad``: a plane seen from two places has a mirror solution. ``None`` when the matches do not determine
    the motion."""
    if len(pairs) < MIN_PAIRS:
        return None
    pairs = np.hstack([straightened(pairs[:, :2], lens), straightened(pairs[:, 2:], lens)])
    rays_w = np.column_stack([pairs[:, :2], np.ones(len(pairs))]) @ r_w_kf.T
    rays_k = np.column_stack([pairs[:, 2:], np.ones(len(pairs))]) @ r_w_k.T
    ahead = (rays_w[:, 2] < MIN_DOWN) & (rays_k[:, 2] < MIN_DOWN)
    if ahead.sum() < MIN_PAIRS:
        return None
    slope = np.array([ground.slope_e, ground.slope_n])
    height_m = ground.height_m
    depth = height_m / np.maximum(rays_w[ahead, :2] @ slope - rays_w[ahead, 2], -MIN_DOWN / 2)
    points = rays_w[ahead] * depth[:, None]  # world axes, from the keyframe's camera
    offsets = rays_k[ahead, :2] / -rays_k[ahead, 2:] * height_m
    turn, scale, shift = _similarity(offsets, points[:, :2])
    start = np.array([*shift, height_m * (scale - 1.0)])
    effective = min(1.0, EFFECTIVE_PAIRS / len(points))
    fit = fit_pose(
        points,
        pairs[ahead, 2:],
        turn @ r_w_k,
        start,
        sigma_norm,
        effective=effective,
        tilt_sigma_rad=tilt_sigma_rad,
        tolerance=FIRST_TOLERANCE,
    )
    if fit is None:
        return None
    tilted_rad = float(np.linalg.norm(log_so3((turn @ r_w_k).T @ fit.r_w_c)[:2]))
    possible_rad = TILT_SIGMAS * tilt_sigma_rad if fit.sigma < FITS * sigma_norm else 0.0
    if tilted_rad > max(MAX_TILT_CHANGE_RAD, possible_rad):
        return None
    cov = fit.cov.copy()
    # A wrong height scales the translation; the tangent's translation is in the new camera's axes.
    t_new = fit.r_w_c.T @ fit.p_c_in_w_m
    cov[3:, 3:] += np.outer(t_new, t_new) * ground.stretch_sigma**2
    up = fit.r_w_c[2]
    cov[3:, 3:] += ground.rise_sigma_m**2 * np.outer(up, up)
    # A wrong slope of the plane turns the camera by about slope times base over height.
    cov[:3, :3] += (ground.slope_sigma * float(np.linalg.norm(t_new)) / height_m) ** 2 * np.eye(3)
    seen = Seen(pairs[ahead], fit.sigma / float(np.sqrt(effective)), ground, lens)
    return RelativePose(r_w_kf.T @ fit.r_w_c, r_w_kf.T @ fit.p_c_in_w_m, cov, seen)


def similarity_ratio(a: np.ndarray, b: np.ndarray) -> complex:
    """b = ratio * a by least squares over complex numbers (N,) of zero mean: scale and turn (Umeyama 1991)."""
    return complex(np.vdot(a, b) / max(float(np.vdot(a, a).real), 1e-12))


def _similarity(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """b = scale * turn * a + shift by least squares (Umeyama 1991) in the plane; turn as (3x3) about up."""
    mean_a, mean_b = a.mean(0), b.mean(0)
    za, zb = (a - mean_a) @ (1, 1j), (b - mean_b) @ (1, 1j)
    ratio = similarity_ratio(za, zb)
    turn = local_rotation_up(float(np.angle(ratio)))
    scale = abs(ratio)
    return turn, scale, mean_b - scale * turn[:2, :2] @ mean_a
