"""Origins of flights."""

from typing import Any

from terrafix.messages import Camera, Origin

PLACE = {"lat_deg": 48.0, "lon_deg": 11.0, "ground_amsl_m": 500.0}
SIGMAS = {"start_sigma_m": 10.0, "yaw_sigma_deg": 3.0, "agl_sigma_m": 3.0, "attitude_sigma_deg": 2.0}


def origin_of(camera: Camera, **changes: Any) -> Origin:
    """-> the origin of a flight with this camera, with other fields as ``changes``."""
    return Origin(t_ns=0, camera=camera, **PLACE | SIGMAS | changes)
