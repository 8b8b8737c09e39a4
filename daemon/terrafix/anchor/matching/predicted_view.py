"""The predicted camera over the ground as the map has it."""

import numpy as np

from terrafix.anchor.matching.frame_matcher import View
from terrafix.core.geodesy import rot_from_quat
from terrafix.map.package import LocalMap
from terrafix.messages import Prediction, Vec3


def ground_plane(source: LocalMap, e_m: float, n_m: float, agl_m: float) -> tuple[Vec3 | None, float]:
    """Least squares over the ground that is seen: AMSL below the camera, slope east, slope north; and what is left
    (rms)."""
    axis = np.linspace(-0.7, 0.7, 7) * agl_m
    de, dn = (a.ravel() for a in np.meshgrid(axis, axis))
    up = source.elevation(e_m + de, n_m + dn)
    if up is None or np.isfinite(up).sum() < len(de) / 2:
        return None, 0.0
    known = np.isfinite(up)
    design = np.column_stack([np.ones(known.sum()), de[known], dn[known]])
    plane = np.linalg.lstsq(design, up[known], rcond=None)[0]
    relief_m = float(np.sqrt(np.mean((up[known] - design @ plane) ** 2)))
    return (float(plane[0]), float(plane[1]), float(plane[2])), relief_m


def view_of(prediction: Prediction, ground: Vec3 | None, ground_m: float) -> View:
    """``ground``: the plane below the prediction; None: not known, or not to be believed. Then the height above ground
    is the reported one, over the level ``ground_m`` (AMSL)."""
    e_m, n_m, up_m = prediction.p_c_in_w_m
    agl_m = prediction.agl_m if ground is None else up_m - ground[0]
    return View(
        e_m,
        n_m,
        rot_from_quat(prediction.q_w_c),
        agl_m,
        ground_m if ground is None else ground[0],
        float(np.sqrt(prediction.cov[35])),
        prediction.agl_sigma_m / max(agl_m, 1.0),
        float(np.sqrt(max(prediction.cov[21], prediction.cov[28]))),
    )
