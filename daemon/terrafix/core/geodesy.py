"""WGS84 <-> local metres, and attitude conversions between Euler angles, rotation matrices and quaternions."""

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pyproj import CRS, Transformer

# Transverse Mercator with centre and unit scale at the origin: metres, grid north = true north at the origin.
# The scale error is below 1e-6 within 9 km of the central meridian (Snyder, USGS PP 1395, eq. 8-11).
LOCAL = "+proj=tmerc +lat_0={lat_deg:.9f} +lon_0={lon_deg:.9f} +k=1 +x_0=0 +y_0=0"


def local_crs(lat_deg: float, lon_deg: float) -> "CRS":
    """The projected CRS of ``LocalFrame``, for pyproj."""
    from pyproj import CRS  # imported here: link and vision use only the rotations, and must restart quickly

    return CRS.from_proj4(LOCAL.format(lat_deg=lat_deg, lon_deg=lon_deg) + " +datum=WGS84 +units=m")


@lru_cache(maxsize=16)
def transformer(source: "CRS | int", target: "CRS | str") -> "Transformer":
    """From x and y to x and y, for pyproj; each pair costs a look-up in its database of 10 to 25 ms once."""
    from pyproj import Transformer

    return Transformer.from_crs(source, target, always_xy=True)


@dataclass(frozen=True)
class LocalFrame:
    """Local frame: east and north in metres about (lat_deg, lon_deg). Heights stay AMSL and are not converted."""

    lat_deg: float
    lon_deg: float
    _from_wgs84: "Transformer" = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        from pyproj import Transformer

        # The pipeline that Transformer.from_crs selects, without its database look-up of 10 to 25 ms.
        local = LOCAL.format(lat_deg=self.lat_deg, lon_deg=self.lon_deg)
        steps = f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step {local} +ellps=WGS84"
        object.__setattr__(self, "_from_wgs84", Transformer.from_pipeline(steps))

    def to_local(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """-> (e_m, n_m)"""
        e_m, n_m = self._from_wgs84.transform(lon_deg, lat_deg)
        return float(e_m), float(n_m)

    def to_wgs84(self, e_m: float, n_m: float) -> tuple[float, float]:
        """-> (lat_deg, lon_deg)"""
        lon_deg, lat_deg = self._from_wgs84.transform(e_m, n_m, direction="INVERSE")
        return float(lat_deg), float(lon_deg)


def rot_w_b(yaw_rad: float, pitch_rad: float, roll_rad: float) -> np.ndarray:
    """R_w_b (3x3): rotates body FRD into world ENU. Aerospace Euler angles Z-Y-X [rad], yaw clockwise from north."""
    cy, sy = math.cos(yaw_rad), math.sin(yaw_rad)
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    r_ned_b = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    r_enu_ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return r_enu_ned @ r_ned_b


def euler_from_rot(r_w_b: np.ndarray) -> tuple[float, float, float]:
    """Inverse of ``rot_w_b``: R_w_b (3x3) -> yaw, pitch, roll [rad]."""
    pitch_rad = math.asin(max(-1.0, min(1.0, float(r_w_b[2, 0]))))
    return yaw_of(r_w_b), pitch_rad, math.atan2(-float(r_w_b[2, 1]), -float(r_w_b[2, 2]))


def yaw_of(r_w_b: np.ndarray) -> float:
    """Heading [rad] of the body's forward axis in R_w_b (3x3), clockwise from north, in (-pi, pi]."""
    return math.atan2(float(r_w_b[0, 0]), float(r_w_b[1, 0]))


def quat_from_rot(r: np.ndarray) -> tuple[float, float, float, float]:
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix (3x3). Shepperd's method."""
    k = np.array([r[0, 0] + r[1, 1] + r[2, 2], r[0, 0], r[1, 1], r[2, 2]])
    i = int(np.argmax(k))
    if i == 0:
        q = np.array([1.0 + k[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]])
    elif i == 1:
        q = np.array([r[2, 1] - r[1, 2], 1.0 + 2 * r[0, 0] - k[0], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0]])
    elif i == 2:
        q = np.array([r[0, 2] - r[2, 0], r[0, 1] + r[1, 0], 1.0 + 2 * r[1, 1] - k[0], r[1, 2] + r[2, 1]])
    else:
        q = np.array([r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], 1.0 + 2 * r[2, 2] - k[0]])
    q = q / np.linalg.norm(q)
    if q[0] < 0:
        q = -q
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])


def rot_from_quat(q: tuple[float, float, float, float]) -> np.ndarray:
    """Rotation matrix (3x3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def local_rotation_up(angle_rad: float) -> np.ndarray:
    """Rotation (3x3) about the world's up axis by ``angle_rad``, counter-clockwise seen from above."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
