"""The camera and origin of a flight that was created over HTTP, by the rules of flight.toml."""

from pathlib import Path

import msgspec

from terrafix.messages import Camera, Origin
from terrafix.vision.sources.description import (
    CameraTable,
    Description,
    MountTable,
    StartTable,
    TelemetryTable,
    camera_of,
    origin_of,
)
from terrafix.vision.sources.images import downscale_factor, downscaled_camera
from terrafix_tools.console.payloads import NewFlight

WHERE = Path("camera")  # named in errors


def stored_camera(new: NewFlight) -> Camera:
    """The camera of the uploaded images. Raises SourceError."""
    return camera_of(WHERE, _description(new))


def origin(new: NewFlight, attitude_sigma_deg: float) -> Origin:
    """The Origin of the flight, with the camera of the images as they are read. ``attitude_sigma_deg``: where the
    flight does not state it. Raises SourceError."""
    description = _description(new)
    return origin_of(description, downscaled_camera(camera_of(WHERE, description)), None, attitude_sigma_deg)


def stored_pixel(u: float, v: float, new: NewFlight) -> tuple[float, float]:
    """Pixel of an uploaded image -> pixel of the frame that it became."""
    by = downscale_factor(new.camera.width)
    return (u + 0.5) / by - 0.5, (v + 0.5) / by - 0.5


def _description(new: NewFlight) -> Description:
    given, start = new.camera, new.start
    fx = given.fx
    if fx is None:
        assert given.focal_mm is not None and given.sensor_width_mm is not None  # checked by the payload
        fx = given.focal_mm / given.sensor_width_mm * given.width
    camera = CameraTable(
        width=given.width,
        height=given.height,
        fx=fx,
        fy=given.fy if given.fy is not None else fx,
        cx=given.cx if given.cx is not None else given.width / 2,
        cy=given.cy if given.cy is not None else given.height / 2,
        distortion=tuple(given.distortion),
        focal_sigma=given.focal_sigma,
    )
    return Description(
        camera=camera,
        mount=msgspec.convert(new.mount.model_dump(), MountTable),
        telemetry=msgspec.convert(new.telemetry.model_dump(), TelemetryTable),
        start=None
        if start is None
        else StartTable(lat_deg=start.lat, lon_deg=start.lon, sigma_m=start.sigma_m, ground_amsl_m=start.ground_amsl_m),
    )
