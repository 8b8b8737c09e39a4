"""Attitude, height and calibration of a photo from its XMP, as DJI, Autel, Pix4D's partners and Parrot write them.

References: DJI's namespace ``drone-dji``; Pix4D's "Specifications of XMP Camera Tags" (namespace ``Camera``), which
Autel, senseFly, MicaSense and Parrot use, too; Parrot's namespace ``drone-parrot``. Numbers may be rationals
("1250/10")."""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from terrafix.core.geodesy import euler_from_rot, rot_w_b

_NUMBER = r"[+-]?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?"
_VALUE = rf"({_NUMBER})(?:\s*/\s*({_NUMBER}))?"
_PIX4D_URI = "pix4d.com/camera"
# Pix4D: pitch 0 looks down and 90 forward. Some models of Autel, and Parrot, write the angle from the horizon there:
# -90 looks down. No camera of a map looks backward by this much, so a lower pitch is one from the horizon.
# [spec: Theta-Limited/OpenAthenaIOS#62]
_FROM_HORIZON_DEG = -45.0
PIX4D = "Pix4D's tags"  # source of angles
_AXES = ("Yaw", "Pitch", "Roll")
_Numbers = Callable[[str], float | None]  # of one maker, by key


@dataclass(frozen=True)
class BodyAngles:
    """Attitude in degrees of a virtual vehicle that carries the camera straight down with the image top forward."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float
    source: str


@dataclass(frozen=True)
class Xmp:
    """None: not stated."""

    angles: BodyAngles | None = None  # of the camera
    heading_deg: float | None = None  # of the vehicle, where the camera's is not known
    flight_yaw_deg: float | None = None  # of the vehicle, beside angles of the camera
    agl_m: float | None = None  # above take-off (DJI) or ground
    agl_from: str = ""
    focal_px: float | None = None  # of the calibrated size
    centre_px: tuple[float, float] | None = None  # of the calibrated size
    focal_mm: float | None = None
    notes: tuple[str, ...] = ()  # what is stated and not used, in words


def read_xmp(packet: bytes) -> Xmp:
    """``packet``: the XMP of a photo; may be damaged."""
    text = packet.decode("utf-8", errors="replace")
    dji, pix4d, parrot = (
        partial(_number, text, prefixes) for prefixes in (("drone-dji",), _pix4d_prefixes(text), ("drone-parrot",))
    )
    angles, notes = _angles(dji, pix4d, parrot)
    heights = (
        (dji("RelativeAltitude"), "RelativeAltitude of DJI"),
        (pix4d("AboveGroundAltitude"), "AboveGroundAltitude of Pix4D's tags"),
    )
    agl_m, agl_from = next((height for height in heights if height[0] is not None), (None, ""))
    x_px, y_px, focal_px = (dji(f"Calibrated{what}") for what in ("OpticalCenterX", "OpticalCenterY", "FocalLength"))
    yaws = None if notes else dji("GimbalYawDegree"), dji("FlightYawDegree"), parrot("CameraYawDegree")
    return Xmp(
        angles=angles,
        heading_deg=next((yaw for yaw in yaws if yaw is not None), None),
        flight_yaw_deg=dji("FlightYawDegree"),
        agl_m=agl_m,
        agl_from=agl_from,
        focal_px=focal_px if focal_px is not None and focal_px > 0 else None,
        centre_px=None if x_px is None or y_px is None else (x_px, y_px),
        focal_mm=pix4d("PerspectiveFocalLength"),
        notes=notes,
    )


def body_angles_from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float) -> tuple[float, float, float]:
    """(yaw, pitch, roll) in rad of a body whose camera is mounted at pitch -90, from the gimbal's Z-Y-X angles."""
    r_w_gimbal = rot_w_b(math.radians(yaw_deg), math.radians(pitch_deg), math.radians(roll_deg))
    r_gimbal_b = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # Ry(+90)
    return euler_from_rot(r_w_gimbal @ r_gimbal_b)  # undoes the mount


def _angles(dji: _Numbers, pix4d: _Numbers, parrot: _Numbers) -> tuple[BodyAngles | None, tuple[str, ...]]:
    yaw, pitch, roll = (dji(f"Gimbal{axis}Degree") for axis in _AXES)
    if yaw is not None and pitch is not None:
        # Firmware that does not know its gimbal writes zeros, which would be a level view to the north.
        if yaw == pitch == (roll or 0.0) == 0.0:
            return None, ("gimbal angles of 0/0/0: not reported",)
        return _from_gimbal(yaw, pitch, roll or 0.0, "gimbal angles of DJI"), ()
    yaw, pitch, roll = map(pix4d, _AXES)
    if yaw is not None and pitch is not None:
        if pitch < _FROM_HORIZON_DEG:
            return _from_gimbal(yaw, pitch, roll or 0.0, "Pix4D's tags, pitch from the horizon"), ()
        return BodyAngles(yaw, pitch, roll or 0.0, PIX4D), ()
    yaw, pitch, roll = (parrot(f"Camera{axis}Degree") for axis in _AXES)
    if yaw is not None and pitch is not None and pitch < _FROM_HORIZON_DEG:
        return _from_gimbal(yaw, pitch, roll or 0.0, "camera angles of Parrot"), ()
    return None, ()


def _from_gimbal(yaw_deg: float, pitch_deg: float, roll_deg: float, source: str) -> BodyAngles:
    yaw, pitch, roll = map(math.degrees, body_angles_from_gimbal(yaw_deg, pitch_deg, roll_deg))
    return BodyAngles(yaw, pitch, roll, source)


def _pix4d_prefixes(text: str) -> tuple[str, ...]:
    """Prefixes that a packet gives to Pix4D's namespace."""
    declared = re.findall(r"xmlns:([\w.-]+)\s*=\s*[\"'][^\"']*" + re.escape(_PIX4D_URI), text)
    return tuple(dict.fromkeys((*declared, "Camera")))


def _number(text: str, prefixes: tuple[str, ...], key: str) -> float | None:
    """A number that is written as an attribute or as an element; None: not stated, or not finite."""
    for prefix in prefixes:
        match = re.search(rf"(?<![\w.-]){re.escape(prefix)}:{key}\s*(?:=\s*[\"']|>)\s*{_VALUE}", text)
        if match:
            value, divisor = float(match[1]), float(match[2] or 1.0)
            value = value / divisor if divisor else math.nan
            if math.isfinite(value):
                return value
    return None
