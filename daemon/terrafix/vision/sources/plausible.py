"""Camera descriptions that cannot be: refused when they are read, with what was probably meant."""

import math
from pathlib import Path

from terrafix.core.camera import Mount
from terrafix.core.errors import SourceError
from terrafix.messages import Camera

WIDEST_DEG = 160.0  # a pinhole model of a wider lens has its edge at six focal lengths: none is calibrated so
NARROWEST_DEG = 3.0  # a 600 mm lens on a full frame is 3.4 degrees wide
MOST_OBLONG = 2.0  # fx over fy: pixels of anamorphic video are 1.46 at most (ITU-R BT.601, 16:9)
LONGEST_MM = 100.0  # a number that small beside a wide picture is a focal length in millimetres
LEAST_DOWN = 0.2  # down component of the optical axis: flatter rays meet the ground farther than five heights away
HIGHEST_M = 5000.0  # above ground: a pixel of the finest lens that is accepted here shows less than any map does


def check_camera(path: Path, camera: Camera) -> None:
    """Raises SourceError for a field of view, pixels or a mount that cannot be. ``path``: the file that says so."""
    for name, focal, size in (("fx", camera.fx, camera.width), ("fy", camera.fy, camera.height)):
        view_deg = math.degrees(2.0 * math.atan(0.5 * size / focal))
        seen = f"{path}: [camera] {name} = {focal:g} and {size} px are a field of view of {view_deg:.1f} degrees"
        if view_deg > WIDEST_DEG:
            millimetres = focal < LONGEST_MM and size > LONGEST_MM
            meant = (
                f"is that in millimetres? {name} is in pixels: millimetres / sensor size in millimetres * {size}"
                if millimetres
                else "give the focal length in pixels of the stored frames"
            )
            raise SourceError(f"{seen}, more than {WIDEST_DEG:.0f}; {meant}")
        if view_deg < NARROWEST_DEG:
            raise SourceError(
                f"{seen}, less than {NARROWEST_DEG:.0f}; give the focal length in pixels of the stored frames"
            )
    ratio = camera.fx / camera.fy
    if not 1.0 / MOST_OBLONG <= ratio <= MOST_OBLONG:
        raise SourceError(
            f"{path}: [camera] fx is {ratio:.2f} times fy; both are in pixels of the stored frames and nearly the same"
        )
    if Mount.of(camera).r_b_c()[2, 2] < LEAST_DOWN:
        raise SourceError(
            f"{path}: [mount] pitch_deg = {camera.mount_pitch_deg:g} and roll_deg = {camera.mount_roll_deg:g} do not "
            "look down at the ground; -90 is straight down"
        )


def check_heights(path: Path, agl_m: list[float]) -> None:
    """Raises SourceError where most heights above the ground cannot be metres. ``path``: the table."""
    if not agl_m:
        return
    middle_m = sorted(agl_m)[len(agl_m) // 2]
    if middle_m > HIGHEST_M:
        raise SourceError(
            f"{path}: agl_m is {middle_m:g} in half of the rows, more than {HIGHEST_M:.0f} m above the ground; "
            "is that in centimetres or millimetres? write metres"
        )
