"""EXIF and XMP of one photo: time, lens, coordinate, height, attitude of the camera.

Reference: EXIF 2.32 (JEITA CP-3451E) for the tags; ``xmp`` for the rest."""

import math
import warnings
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from terrafix.vision.sources.lens import Lens, LensTags, lens_of
from terrafix.vision.sources.xmp import Xmp, read_xmp

# Tags of the EXIF and GPS directories.
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_MODEL, _DATETIME = 0x0110, 0x0132
_DATETIME_ORIGINAL, _SUBSEC_ORIGINAL = 0x9003, 0x9291
_FOCAL_MM, _FOCAL_35 = 0x920A, 0xA405
_EXIF_WIDTH, _EXIF_HEIGHT = 0xA002, 0xA003
_DIGITAL_ZOOM = 0xA404
_PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}  # inch (also the default), centimetre, millimetre


@dataclass(frozen=True)
class PhotoInfo:
    """Metadata of a photo; None and absent keys are unknown."""

    width: int
    height: int
    taken: datetime | None = None  # local time of the camera; valid for differences only
    has_subsec: bool = False
    model: str = ""
    lens: Lens = field(default_factory=Lens)
    lat_deg: float | None = None
    lon_deg: float | None = None
    xmp: Xmp = field(default_factory=Xmp)

    @property
    def focal_px(self) -> float | None:
        return self.lens.focal_px


def read_info(path: Path) -> PhotoInfo | None:
    """Metadata of a photo; None when it is not a readable image."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            width, height = image.size
            exif = image.getexif()
            main: dict[int, Any] = {**dict(exif), **exif.get_ifd(_EXIF_IFD)}
            gps: dict[int, Any] = dict(exif.get_ifd(_GPS_IFD))
            packet = image.info.get("xmp", b"")
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError, Image.DecompressionBombError):
        return None  # Pillow raises these for broken headers and directories
    xmp = read_xmp(packet if isinstance(packet, bytes) else str(packet).encode())
    taken, has_subsec = _capture_time(main)
    lat_deg, lon_deg = _angle(gps, 2, 1, "S", 90.0), _angle(gps, 4, 3, "W", 180.0)
    if lat_deg == 0.0 and lon_deg == 0.0:
        lat_deg = lon_deg = None  # cameras write 0, 0 before they have a fix
    model = _text(main.get(_MODEL))
    lens = lens_of(_lens_tags(main, model, xmp), width, height)
    return PhotoInfo(width, height, taken, has_subsec, model, lens, lat_deg, lon_deg, xmp)


def _capture_time(main: dict[int, Any]) -> tuple[datetime | None, bool]:
    """Time of capture, and whether it has a fraction of a second."""
    text = _text(main.get(_DATETIME_ORIGINAL)) or _text(main.get(_DATETIME))
    try:
        taken = datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None, False
    subsec = _text(main.get(_SUBSEC_ORIGINAL))
    if not subsec.isdecimal():
        return taken, False
    return taken.replace(microsecond=int(f"{subsec:0<6}"[:6])), True


def _lens_tags(main: dict[int, Any], model: str, xmp: Xmp) -> LensTags:
    per_unit, unit = _number(main.get(_PLANE_X_RESOLUTION)), main.get(_PLANE_UNIT, 2)
    return LensTags(
        model=model,
        focal_mm=_number(main.get(_FOCAL_MM)),
        focal_35_mm=_number(main.get(_FOCAL_35)),
        digital_zoom=_number(main.get(_DIGITAL_ZOOM)),
        px_per_mm=per_unit / _PLANE_UNIT_MM[unit] if per_unit and unit in _PLANE_UNIT_MM else None,
        exif_size=(_number(main.get(_EXIF_WIDTH)), _number(main.get(_EXIF_HEIGHT))),
        calibrated_px=xmp.focal_px,
        calibrated_centre_px=xmp.centre_px,
        calibrated_mm=xmp.focal_mm,
    )


def _angle(gps: dict[int, Any], value: int, reference: int, negative: str, limit_deg: float) -> float | None:
    """Degrees, minutes, seconds -> signed degrees; None when a part is missing or out of range."""
    try:
        degrees, minutes, seconds = (float(part) for part in gps[value])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    if not (math.isfinite(angle) and 0 <= angle <= limit_deg):
        return None
    return -angle if _text(gps.get(reference)) == negative else angle


def _number(value: Any) -> float | None:
    """A positive finite number, else None. EXIF rationals may be 0/0."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _text(value: Any) -> str:
    """A string without the NUL padding of some cameras; "" for other types."""
    return value.replace("\0", " ").strip() if isinstance(value, str) else ""
