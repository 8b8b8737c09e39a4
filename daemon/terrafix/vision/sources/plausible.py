"""Plausibility checks of camera descriptions: an implausible one is rejected with a hint at the probable error."""

import math
from pathlib import Path
from typing import Protocol

from terrafix.core.camera import Mount
from terrafix.core.errors import SourceError
from terrafix.messages import Camera

MAX_FOV_DEG = 160.0  # the image edge of a wider pinhole lens is at six focal lengths; no lens is calibrated that way
MIN_FOV_DEG = 3.0  # a 600 mm lens on a full-frame sensor has 3.4 degrees
MAX_FOCAL_RATIO = 2.0  # fx / fy; pixels of anamorphic video have at most 1.46 (ITU-R BT.601, 16:9)
MAX_FOCAL_MM = 100.0  # a smaller fx with a wide image is probably a focal length in millimetres
MIN_DOWN_COMPONENT = 0.2  # down component of the optical axis: flatter rays hit the ground more than five heights away
MAX_AGL_M = 5000.0  # above ground; at more, a pixel of the narrowest accepted lens is coarser than any map


class PinholeImage(Protocol):
    """What a camera and its table have in common, in pixels."""

    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def cx(self) -> float: ...
    @property
    def cy(self) -> float: ...


def check_centre(path: Path, camera: PinholeImage, what: str = "[camera]") -> None:
    """Raises SourceError for a principal point outside of the image."""
    if not (0 <= camera.cx <= camera.width and 0 <= camera.cy <= camera.height):
        raise SourceError(
            f"{path}: {what} cx, cy ({camera.cx:g}, {camera.cy:g}) lies outside the {camera.width}x{camera.height} "
            "image; all of [camera] is in pixels of the stored frames"
        )


def check_camera(path: Path, camera: Camera, what: str = "[camera]") -> None:
    """Raises SourceError for an implausible field of view, focal ratio, principal point or mount. ``path``: the
    description file, or folder of photos; ``what``: where the camera comes from."""
    check_centre(path, camera, what)
    for name, focal, size in (("fx", camera.fx, camera.width), ("fy", camera.fy, camera.height)):
        fov_deg = math.degrees(2.0 * math.atan(0.5 * size / focal))
        problem = f"{path}: {what} {name} = {focal:g} and {size} px are a field of view of {fov_deg:.1f} degrees"
        if fov_deg > MAX_FOV_DEG:
            millimetres = focal < MAX_FOCAL_MM and size > MAX_FOCAL_MM
            hint = (
                f"is that in millimetres? {name} is in pixels: millimetres / sensor size in millimetres * {size}"
                if millimetres
                else "give the focal length in pixels of the stored frames"
            )
            raise SourceError(f"{problem}, more than {MAX_FOV_DEG:.0f}; {hint}")
        if fov_deg < MIN_FOV_DEG:
            raise SourceError(
                f"{problem}, less than {MIN_FOV_DEG:.0f}; give the focal length in pixels of the stored frames"
            )
    ratio = camera.fx / camera.fy
    if not 1.0 / MAX_FOCAL_RATIO <= ratio <= MAX_FOCAL_RATIO:
        raise SourceError(
            f"{path}: [camera] fx is {ratio:.2f} times fy; both are in pixels of the stored frames and nearly the same"
        )
    if Mount.of(camera).r_b_c()[2, 2] < MIN_DOWN_COMPONENT:
        raise SourceError(
            f"{path}: [mount] pitch_deg = {camera.mount_pitch_deg:g} and roll_deg = {camera.mount_roll_deg:g} do not "
            "look down at the ground; -90 is straight down"
        )


def check_heights(path: Path, agl_m: list[float], what: str = "agl_m", where: str = "rows") -> None:
    """Raises SourceError when the median height above ground is too large for metres. ``path``: the table, or the
    folder of photos; ``what``: the value in words, ``where``: what has it."""
    if not agl_m:
        return
    median_m = sorted(agl_m)[len(agl_m) // 2]
    if median_m > MAX_AGL_M:
        raise SourceError(
            f"{path}: {what} is {median_m:g} in half of the {where}, more than {MAX_AGL_M:.0f} m above the ground; "
            "is that in centimetres or millimetres? write metres"
        )
