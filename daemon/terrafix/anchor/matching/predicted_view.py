"""The predicted camera above the ground of the map."""

import numpy as np

from terrafix.anchor.matching.frame_matcher import View
from terrafix.core.geodesy import rot_from_quat
from terrafix.map.package import LocalMap
from terrafix.messages import GroundPlane, Prediction

# Variances in ``Prediction.cov``, (6, 6) row by row: east, north, rotation about east, north and up; and in
# ``Prediction.step_cov_m2``, (2, 2): east and north. [spec: messages.Prediction]
VAR_E, VAR_N, VAR_TILT_E, VAR_TILT_N, VAR_YAW = 0, 7, 21, 28, 35
VAR_STEP_E, VAR_STEP_N = 0, 3  # [spec: messages.Prediction]


def ground_plane(source: LocalMap, e_m: float, n_m: float, agl_m: float) -> GroundPlane | None:
    """Least-squares plane through the map's elevation below the camera. None if less than half of the ground is
    known."""
    axis = np.linspace(-0.7, 0.7, 7) * agl_m
    de, dn = (a.ravel() for a in np.meshgrid(axis, axis))
    up = source.elevation(e_m + de, n_m + dn)
    if up is None or np.isfinite(up).sum() < len(de) / 2:
        return None
    known = np.isfinite(up)
    design = np.column_stack([np.ones(known.sum()), de[known], dn[known]])
    plane = np.linalg.lstsq(design, up[known], rcond=None)[0]
    relief_m = float(np.sqrt(np.mean((up[known] - design @ plane) ** 2)))
    return GroundPlane(amsl_m=float(plane[0]), slope_e=float(plane[1]), slope_n=float(plane[2]), relief_m=relief_m)


def view_of(prediction: Prediction, ground: GroundPlane | None, ground_m: float) -> View:
    """``ground``: plane below the prediction; None: unknown, or the position is not trusted. Then the reported height
    above ground is used, over the level ``ground_m`` (AMSL)."""
    e_m, n_m, up_m = prediction.p_c_in_w_m
    agl_m = prediction.agl_m if ground is None else up_m - ground.amsl_m
    return View(
        e_m,
        n_m,
        rot_from_quat(prediction.q_w_c),
        agl_m,
        ground_m if ground is None else ground.amsl_m,
        float(np.sqrt(prediction.cov[VAR_YAW])),
        prediction.agl_sigma_m / max(agl_m, 1.0),
        tilt_sigma_rad(prediction),
        np.inf if ground is None else position_sigma_m(prediction),
    )


def position_sigma_m(prediction: Prediction) -> float:
    """Horizontal 1-sigma of the predicted position, the larger of both axes."""
    return float(np.sqrt(max(prediction.cov[VAR_E], prediction.cov[VAR_N])))


def tilt_sigma_rad(prediction: Prediction) -> float:
    """1-sigma of the predicted tilt, the larger of both axes."""
    return float(np.sqrt(max(prediction.cov[VAR_TILT_E], prediction.cov[VAR_TILT_N])))
