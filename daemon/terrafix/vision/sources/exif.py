"""EXIF and XMP of one photo: time, focal length, coordinate; height and gimbal attitude of DJI drones.

References: EXIF 2.32 (JEITA CP-3451E) for the tags; DJI's XMP namespace ``drone-dji`` for the rest."""

import math
import re
import warnings
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

# Tags of the EXIF and GPS directories.
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_MODEL, _DATETIME = 0x0110, 0x0132
_DATETIME_ORIGINAL, _SUBSEC_ORIGINAL = 0x9003, 0x9291
_FOCAL_MM, _FOCAL_35 = 0x920A, 0xA405
_EXIF_WIDTH = 0xA002
_PLANE_X_RESOLUTION, _PLANE_UNIT = 0xA20E, 0xA210
_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0}  # inch (also the default), centimetre, millimetre

# Width of the whole sensor in mm, from the manufacturers; every mode of these cameras uses the whole width.
SENSOR_WIDTH_MM = {
    "FC220": 6.17,  # Mavic Pro
    "FC300C": 6.17,  # Phantom 3 Standard
    "FC300S": 6.17,  # Phantom 3 Advanced
    "FC300X": 6.17,  # Phantom 3 Professional
    "FC330": 6.17,  # Phantom 4
    "FC350": 6.17,  # Zenmuse X3
    "FC6310": 13.2,  # Phantom 4 Pro
    "FC6310R": 13.2,  # Phantom 4 RTK
    "FC6310S": 13.2,  # Phantom 4 Pro V2
    "L1D-20c": 13.2,  # Mavic 2 Pro
    "M3E": 17.3,  # Mavic 3 Enterprise
}
DIAGONAL_35_MM = 43.267  # diagonal of 36x24 mm: the 35 mm equivalent focal length refers to diagonals (CIPA DCG-001)
WIDE_ASPECT = 1.6  # a wider photo is a crop of a 4:3 sensor; the 35 mm equivalent refers to the sensor's diagonal
XMP_NUMBERS = (
    "RelativeAltitude",
    "GimbalYawDegree",
    "GimbalPitchDegree",
    "GimbalRollDegree",
    "FlightYawDegree",
    "CalibratedFocalLength",
    "CalibratedOpticalCenterX",
    "CalibratedOpticalCenterY",
)


@dataclass(frozen=True)
class PhotoInfo:
    """Metadata of a photo; None and absent keys are unknown."""

    width: int
    height: int
    taken: datetime | None = None  # local time of the camera; valid for differences only
    has_subsec: bool = False
    focal_px: float | None = None
    focal_from: str = ""
    lat_deg: float | None = None
    lon_deg: float | None = None
    xmp: dict[str, float] = field(default_factory=dict)


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
    xmp = _xmp(packet if isinstance(packet, bytes) else str(packet).encode())
    taken, has_subsec = _capture_time(main)
    focal_px, focal_from = _focal_px(main, xmp, width, height)
    lat_deg, lon_deg = _angle(gps, 2, 1, "S", 90.0), _angle(gps, 4, 3, "W", 180.0)
    if lat_deg == 0.0 and lon_deg == 0.0:
        lat_deg = lon_deg = None  # cameras write 0, 0 before they have a fix
    return PhotoInfo(width, height, taken, has_subsec, focal_px, focal_from, lat_deg, lon_deg, xmp)


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


def _focal_px(main: dict[int, Any], xmp: dict[str, float], width: int, height: int) -> tuple[float | None, str]:
    """Focal length in pixels of the stored photo from the most accurate tag available, and the name of that tag."""
    stored = _number(main.get(_EXIF_WIDTH)) or float(width)
    resized = width / stored if stored >= 1 else 1.0
    if xmp.get("CalibratedFocalLength", 0.0) > 0:
        return xmp["CalibratedFocalLength"] * resized, "CalibratedFocalLength"
    focal_mm = _number(main.get(_FOCAL_MM))
    sensor_mm = SENSOR_WIDTH_MM.get(_text(main.get(_MODEL)))
    if focal_mm and sensor_mm:
        return focal_mm / sensor_mm * max(width, height), "FocalLength and the sensor table"
    per_unit, unit = _number(main.get(_PLANE_X_RESOLUTION)), main.get(_PLANE_UNIT, 2)
    if focal_mm and per_unit and unit in _PLANE_UNIT_MM:
        return focal_mm * per_unit / _PLANE_UNIT_MM[unit] * resized, "FocalLength and FocalPlaneXResolution"
    focal_35_mm = _number(main.get(_FOCAL_35))
    if focal_35_mm:
        long, short = max(width, height), min(width, height)
        diagonal_px = math.hypot(long, short if long / short <= WIDE_ASPECT else long * 3 / 4)
        return focal_35_mm / DIAGONAL_35_MM * diagonal_px, "FocalLengthIn35mmFilm"
    return None, ""


def _xmp(packet: bytes) -> dict[str, float]:
    """DJI's numeric XMP fields, written as attributes or as elements."""
    text = packet.decode("utf-8", errors="replace")
    found: dict[str, float] = {}
    for key in XMP_NUMBERS:
        match = re.search(rf"drone-dji:{key}\s*(?:=\s*[\"']|>)\s*([+-]?\d+(?:\.\d+)?)", text)
        if match:
            found[key] = float(match.group(1))
    return found


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
