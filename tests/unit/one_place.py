"""One piece of ground, one camera above it, and a package that is the map of it: for tests of the anchor."""

from types import SimpleNamespace

import numpy as np
from ground import PINHOLE, FlatMap, rotation

from terrafix.messages import Camera, Origin

AGL_M = 100.0
SIDE_M = 400.0
R = rotation(40.0)
TRUE_M = np.array([20.0, -10.0, AGL_M])


ORIGIN = Origin(
    t_ns=0,
    camera=Camera(width=640, height=360, fx=PINHOLE.fx, fy=PINHOLE.fy, cx=319.5, cy=179.5),
    lat_deg=48.0,
    lon_deg=11.0,
    ground_amsl_m=0.0,
    start_sigma_m=10.0,
    yaw_sigma_deg=2.0,
    agl_sigma_m=2.0,
    attitude_sigma_deg=1.0,
)


class OnlyMap(FlatMap):
    """A package and what it is bound to in one."""

    bounds_m = (-SIDE_M / 2, -SIDE_M / 2, SIDE_M / 2, SIDE_M / 2)
    manifest = SimpleNamespace(layers=(SimpleNamespace(table="imagery", ce90_m=None),))

    def bind(self, _frame: object, _layer: str) -> "OnlyMap":
        return self
