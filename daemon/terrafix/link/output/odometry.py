"""The position as a pose around the autopilot's own origin: ODOMETRY (331) and VISION_POSITION_ESTIMATE (102).

Both say the position of this moment, north, east and down of the filter's origin in metres, made of degrees as the
firmware itself does it, so that it comes back to the same latitude and longitude. Without a 3D fix nothing is said:
neither message can say "no fix", and the filter gives the stream up after 300 ms."""

import math
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

# ArduPilot's Location: metres per 1e-7 degree, on both axes, times the cosine of the mean latitude for east
# (AP_Math/definitions.h LATLON_TO_M; Location::get_distance_NE). A true ellipsoid would be 10 m off after 10 km.
ARDUPILOT_M_PER_E7 = 0.011131884502145034
PX4_RADIUS_M = 6_371_000.0  # of PX4's sphere (geo.h), on which it has an azimuthal equidistant projection
YAW_UNKNOWN_RAD = math.pi  # 1-sigma: the attitude in these messages is the autopilot's own, and no news to it
QUALITY_GOOD = 100  # of ODOMETRY; what is not good is not sent
RESETS = 256  # reset_counter has 8 bits: a receiver sees that it has changed, and does not take the step for a motion
_XX, _YY, _ZZ, _ROLL, _PITCH, _YAW = 0, 6, 11, 15, 18, 20  # diagonal of the upper triangle, row by row


@dataclass(frozen=True)
class Place:
    """The origin of the autopilot's filter (GPS_GLOBAL_ORIGIN)."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True)
class Attitude:
    """The autopilot's newest: body (forward, right, down) against north, east, down."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float


def north_east_down(gps: GpsInput, origin: Place, *, ardupilot: bool) -> tuple[float, float, float]:
    """Metres from the origin, on ArduPilot's plane or PX4's sphere: 10 km are 11 m longer on the one."""
    if not ardupilot:
        return *_on_sphere(gps, origin), origin.alt_amsl_m - gps.alt_amsl_m
    north = (gps.lat_deg - origin.lat_deg) * 1e7 * ARDUPILOT_M_PER_E7
    east_deg = math.remainder(gps.lon_deg - origin.lon_deg, 360.0)
    middle = math.radians((gps.lat_deg + origin.lat_deg) / 2)
    return north, east_deg * 1e7 * ARDUPILOT_M_PER_E7 * math.cos(middle), origin.alt_amsl_m - gps.alt_amsl_m


def _on_sphere(gps: GpsInput, origin: Place) -> tuple[float, float]:
    """As PX4's MapProjection::project."""
    lat, lat0 = math.radians(gps.lat_deg), math.radians(origin.lat_deg)
    east_rad = math.radians(gps.lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(east_rad)
    east = math.cos(lat) * math.sin(east_rad)
    sine = math.hypot(north, east)  # of the angle between the two places
    if sine == 0.0:
        return 0.0, 0.0
    cosine = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(east_rad)
    k = PX4_RADIUS_M * math.atan2(sine, cosine) / sine
    return k * north, k * east


def variance_for_ardupilot(sigma: float) -> float:
    """The variance from which ArduPilot makes the error ``sigma``.

    It takes cbrt(xx^2 + yy^2 + zz^2) of three variances for a standard deviation (GCS_Common.cpp, handle_odometry);
    three equal ones give sigma when each is sqrt(sigma^3 / 3)."""
    return math.sqrt(sigma**3 / 3.0)


def pose_covariance(gps: GpsInput, *, ardupilot: bool) -> list[float]:
    """(21,) upper triangle of x, y, z, roll, pitch, yaw. ArduPilot gets three equal ones for its rule: the horizontal
    error, since height is the barometer's there (EK3_SRCn_POSZ 1)."""
    cov = [0.0] * 21
    if ardupilot:
        cov[_XX] = cov[_YY] = cov[_ZZ] = variance_for_ardupilot(gps.horiz_accuracy_m)
        cov[_ROLL] = cov[_PITCH] = cov[_YAW] = variance_for_ardupilot(YAW_UNKNOWN_RAD)
    else:
        cov[_XX] = cov[_YY] = gps.horiz_accuracy_m**2
        cov[_ZZ] = gps.vert_accuracy_m**2
        cov[_ROLL] = cov[_PITCH] = cov[_YAW] = YAW_UNKNOWN_RAD**2
    return cov


def odometry(gps: GpsInput, origin: Place, attitude: Attitude, *, ardupilot: bool) -> mavlink.MAVLink_odometry_message:
    """The velocity is in body axes; the receiver turns it back with the quaternion of the same message.

    North, east and down is MAV_FRAME_LOCAL_FRD to ArduPilot, which takes no other. For PX4 it is MAV_FRAME_LOCAL_NED:
    in FRD the distance from the origin times the error of our yaw, which we call unknown, would be error of the
    position."""
    q = quaternion(attitude)
    velocity_cov = [0.0] * 21
    velocity_cov[_XX] = velocity_cov[_YY] = velocity_cov[_ZZ] = gps.speed_accuracy_mps**2
    return mavlink.MAVLink_odometry_message(
        gps.t_ns // 1000,
        mavlink.MAV_FRAME_LOCAL_FRD if ardupilot else mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *north_east_down(gps, origin, ardupilot=ardupilot),
        q,
        *into_body(q, (gps.vn_mps, gps.ve_mps, gps.vd_mps)),
        math.nan,  # turn rates: the autopilot's gyroscopes know better
        math.nan,
        math.nan,
        pose_covariance(gps, ardupilot=ardupilot),
        velocity_cov,
        reset_counter=gps.resets % RESETS,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VISION,
        quality=QUALITY_GOOD,
    )


def vision_position(
    gps: GpsInput, origin: Place, attitude: Attitude, *, ardupilot: bool
) -> mavlink.MAVLink_vision_position_estimate_message:
    return mavlink.MAVLink_vision_position_estimate_message(
        gps.t_ns // 1000,
        *north_east_down(gps, origin, ardupilot=ardupilot),
        attitude.roll_rad,
        attitude.pitch_rad,
        attitude.yaw_rad,
        pose_covariance(gps, ardupilot=ardupilot),
        reset_counter=gps.resets % RESETS,
    )


def quaternion(attitude: Attitude) -> tuple[float, float, float, float]:
    """(w, x, y, z), body to north-east-down; yaw, then pitch, then roll."""
    cr, sr = math.cos(attitude.roll_rad / 2), math.sin(attitude.roll_rad / 2)
    cp, sp = math.cos(attitude.pitch_rad / 2), math.sin(attitude.pitch_rad / 2)
    cy, sy = math.cos(attitude.yaw_rad / 2), math.sin(attitude.yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def into_body(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    """A vector in north-east-down, in body axes: the inverse rotation of ``q``."""
    w, (x, y, z) = q[0], (-q[1], -q[2], -q[3])
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )
