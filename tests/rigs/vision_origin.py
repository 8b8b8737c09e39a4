"""Origin of a flight for tests of vision, which uses its camera alone."""

from terrafix.messages import Camera, Origin
from textured_ground import PINHOLE


def origin_of(camera: Camera) -> Origin:
    return Origin(
        t_ns=0,
        camera=camera,
        lat_deg=47.0,
        lon_deg=8.0,
        ground_amsl_m=0.0,
        start_sigma_m=10.0,
        yaw_sigma_deg=3.0,
        agl_sigma_m=3.0,
        attitude_sigma_deg=1.0,
    )


PINHOLE_ORIGIN = origin_of(
    Camera(width=PINHOLE.width, height=PINHOLE.height, fx=PINHOLE.fx, fy=PINHOLE.fy, cx=PINHOLE.cx, cy=PINHOLE.cy)
)
