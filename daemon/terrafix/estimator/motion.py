"""Metric camera motion between two frames, from matched rays and the height above the ground."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.pose import exp_so3, fit_pose

EFFECTIVE_PAIRS = 10.0  # relief moves whole blocks of matches together: never more independent ones than this
SCALE_SIGMA = 0.02  # houses and trees lift the mean ground by this share of the height, beyond the height's own error
MIN_PAIRS = 8


@dataclass(frozen=True)
class RelativePose:
    """Camera k in the camera of the keyframe: ``r`` (3x3), ``p_m`` (3,), ``cov`` 6x6 (tangent order)."""

    r: np.ndarray
    p_m: np.ndarray
    cov: np.ndarray


def relative_pose(
    pairs: np.ndarray, sigma_norm: float, r_w_kf: np.ndarray, height_m: float, height_sigma_m: float
) -> RelativePose | None:
    """``pairs`` (N, 4) normalised (x_kf, y_kf, x, y); ``r_w_kf`` gives the direction of the ground plane, ``height_m``
    its distance. ``None`` when the matches do not determine the motion."""
    if len(pairs) < MIN_PAIRS:
        return None
    rays = np.column_stack([pairs[:, :2], np.ones(len(pairs))])
    down = (rays @ r_w_kf.T)[:, 2]
    ahead = down < -0.2  # rays that meet the ground no farther than five heights away
    if ahead.sum() < MIN_PAIRS:
        return None
    rays, xy = rays[ahead], pairs[ahead, 2:]
    points_kf = rays * (-height_m / down[ahead])[:, None]
    start = _initial(points_kf, xy, r_w_kf)
    if start is None:
        return None
    fit = fit_pose(points_kf, xy, *start, sigma_floor=sigma_norm, effective=min(1.0, EFFECTIVE_PAIRS / len(xy)))
    if fit is None:
        return None
    cov = fit.cov.copy()
    # A wrong height scales the translation; the tangent's translation is in the new camera's axes.
    t_new = fit.r_w_c.T @ fit.p_c_in_w_m
    cov[3:, 3:] += np.outer(t_new, t_new) * ((height_sigma_m / height_m) ** 2 + SCALE_SIGMA**2)
    return RelativePose(fit.r_w_c, fit.p_c_in_w_m, cov)


def _initial(points_kf: np.ndarray, xy: np.ndarray, r_w_kf: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Planar PnP (IPPE, Collins & Bartoli 2014) on the ground plane; of its two solutions the one that fits better.

    -> r_kf_k (3x3), p_k_in_kf (3,)"""
    in_w = points_kf @ r_w_kf.T
    centre = in_w.mean(0)
    flat = in_w - centre
    flat[:, 2] = 0.0
    ok, rvecs, tvecs, errors = cv2.solvePnPGeneric(
        flat, np.ascontiguousarray(xy), np.eye(3), np.zeros(4), flags=cv2.SOLVEPNP_IPPE
    )
    if not ok:
        return None
    best = int(np.argmin(np.asarray(errors).ravel()))
    r_k_w = exp_so3(np.asarray(rvecs[best]).ravel())
    p_k_in_w = centre - r_k_w.T @ np.asarray(tvecs[best]).ravel()
    return r_w_kf.T @ r_k_w.T, r_w_kf.T @ p_k_in_w
