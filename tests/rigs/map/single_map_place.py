"""One area of textured ground, one camera pose above it, and a map package of it, for the tests of the anchor."""

from types import SimpleNamespace

import numpy as np

from origins import origin_of
from terrafix.core.geodesy import quat_from_rot
from terrafix.messages import Camera, Prediction
from textured_ground import PINHOLE, FlatMap, rotation

AGL_M = 100.0
SIDE_M = 400.0
R = rotation(40.0)
TRUE_M = np.array([20.0, -10.0, AGL_M])


CAMERA = Camera(width=640, height=360, fx=PINHOLE.fx, fy=PINHOLE.fy, cx=319.5, cy=179.5)
ORIGIN = origin_of(CAMERA, ground_amsl_m=0.0, yaw_sigma_deg=2.0, agl_sigma_m=2.0, attitude_sigma_deg=1.0)


class SingleMapPackage(FlatMap):
    """Both interfaces of a map package: ``MapPackage`` (bind) and ``LocalMap``."""

    bounds_m = (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2)
    manifest = SimpleNamespace(
        layers=(SimpleNamespace(table="imagery", ce90_m=None, ce90_origin=None, null_model=None, is_drawn=False),)
    )

    def bind(self, _frame: object, _layer: str) -> "SingleMapPackage":
        return self


def predicted(
    frame_id: int,
    sigma_m: float,
    *,
    at_m: np.ndarray = TRUE_M,
    step_m: float = 0.0,
    step_sigma_m: float = 1.0,
    prior_t_ns: int = 0,
) -> Prediction:
    """-> prediction of a frame, one frame per second. ``step_m``: motion to the east since the previous frame."""
    cov = np.diag([sigma_m**2, sigma_m**2, 4.0, 4e-4, 4e-4, 1e-3])
    return Prediction(
        t_ns=frame_id * 10**9,
        frame_id=frame_id,
        p_c_in_w_m=(float(at_m[0]), float(at_m[1]), float(at_m[2])),
        q_w_c=quat_from_rot(R),
        cov=tuple(float(v) for v in cov.ravel()),
        agl_m=AGL_M,
        agl_sigma_m=2.0,
        step_m=(step_m, 0.0),
        step_cov_m2=(step_sigma_m**2, 0.0, 0.0, step_sigma_m**2),
        prior_t_ns=prior_t_ns,
    )
