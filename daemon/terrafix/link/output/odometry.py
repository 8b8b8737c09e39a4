"""The position as a pose in the local frame of the autopilot: ODOMETRY (331) and VISION_POSITION_ESTIMATE (102).

Both carry the position at the time of transmission, north, east and down of the origin of the autopilot's EKF in
metres. Metres are computed from degrees as the firmware does it, so that it computes the same latitude and longitude.
Without a 3D fix nothing is sent: neither message can state "no fix", and the EKF stops using the stream after
300 ms."""

import math
from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import GpsInput

# ArduPilot's Location: metres per 1e-7 degree, on both axes, times the cosine of the mean latitude for east
# (AP_Math/definitions.h LATLON_TO_M; Location::get_distance_NE). The true ellipsoid would differ by 10 m after 10 km.
# [spec: ArduPilot LATLON_TO_M]
ARDUPILOT_M_PER_E7 = 0.011131884502145034
PX4_RADIUS_M = 6_371_000.0  # m; sphere of its azimuthal equidistant projection [spec: PX4 geo.h]
YAW_UNKNOWN_RAD = math.pi  # 1-sigma: the attitude in these messages is the autopilot's own, no measurement [tuned]
QUALITY_GOOD = 100  # %, field of ODOMETRY; nothing is sent without a fix [spec: MAVLink ODOMETRY quality]
# Modulus of the 8 bits of reset_counter. A receiver that sees it change does not take the step for a motion.
RESET_COUNTER_MODULUS = 256  # [spec: MAVLink ODOMETRY reset_counter]
# Diagonal of a 6x6 covariance in its upper triangle, row by row. [spec: MAVLink ODOMETRY pose_covariance]
_XX, _YY, _ZZ, _ROLL, _PITCH, _YAW = 0, 6, 11, 15, 18, 20


@dataclass(frozen=True)
class GeodeticPoint:
    """A point such as the origin of the autopilot's EKF (GPS_GLOBAL_ORIGIN)."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float


@dataclass(frozen=True)
class VehicleAttitude:
    """The autopilot's newest attitude: rotation of the body (FRD) in the frame north, east, down."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float


def position_ned_m(gps: GpsInput, origin: GeodeticPoint, *, ardupilot: bool) -> tuple[float, float, float]:
    """-> (north, east, down) [m] of ``origin``, on ArduPilot's plane or PX4's sphere; at 10 km they differ by 11 m."""
    if not ardupilot:
        return *_project_on_sphere(gps, origin), origin.alt_amsl_m - gps.alt_amsl_m
    north = (gps.lat_deg - origin.lat_deg) * 1e7 * ARDUPILOT_M_PER_E7
    east_deg = math.remainder(gps.lon_deg - origin.lon_deg, 360.0)
    mean_lat = math.radians((gps.lat_deg + origin.lat_deg) / 2)
    return north, east_deg * 1e7 * ARDUPILOT_M_PER_E7 * math.cos(mean_lat), origin.alt_amsl_m - gps.alt_amsl_m


def _project_on_sphere(gps: GpsInput, origin: GeodeticPoint) -> tuple[float, float]:
    """-> (north, east) [m], as PX4's MapProjection::project."""
    lat, lat0 = math.radians(gps.lat_deg), math.radians(origin.lat_deg)
    east_rad = math.radians(gps.lon_deg - origin.lon_deg)
    north = math.cos(lat0) * math.sin(lat) - math.sin(lat0) * math.cos(lat) * math.cos(east_rad)
    east = math.cos(lat) * math.sin(east_rad)
    sine = math.hypot(north, east)  # of the angle between the two points
    if sine == 0.0:
        return 0.0, 0.0
    cosine = math.sin(lat0) * math.sin(lat) + math.cos(lat0) * math.cos(lat) * math.cos(east_rad)
    k = PX4_RADIUS_M * math.atan2(sine, cosine) / sine
    return k * north, k * east


def ardupilot_variance(sigma: float) -> float:
    """The variance from which ArduPilot computes the standard deviation ``sigma``.

    It takes cbrt(xx^2 + yy^2 + zz^2) of the three variances as the standard deviation (GCS_Common.cpp,
    handle_odometry). Three equal variances of sqrt(sigma^3 / 3) give sigma."""
    return math.sqrt(sigma**3 / 3.0)


def pose_covariance(gps: GpsInput, *, ardupilot: bool) -> list[float]:
    """(21,) upper triangle over x, y, z, roll, pitch, yaw [m^2, rad^2]. For ArduPilot's rule the three variances of the
    position are equal, from the horizontal accuracy, since its height source is the barometer (EK3_SRCn_POSZ 1)."""
    cov = [0.0] * 21
    if ardupilot:
        cov[_XX] = cov[_YY] = cov[_ZZ] = ardupilot_variance(gps.horiz_accuracy_m)
        cov[_ROLL] = cov[_PITCH] = cov[_YAW] = ardupilot_variance(YAW_UNKNOWN_RAD)
    else:
        cov[_XX] = cov[_YY] = gps.horiz_accuracy_m**2
        cov[_ZZ] = gps.vert_accuracy_m**2
        cov[_ROLL] = cov[_PITCH] = cov[_YAW] = YAW_UNKNOWN_RAD**2
    return cov


def odometry(
    gps: GpsInput, origin: GeodeticPoint, attitude: VehicleAttitude, *, ardupilot: bool
) -> mavlink.MAVLink_odometry_message:
    """ODOMETRY with the velocity in body axes; the autopilot rotates it back with the quaternion of the same message.

    The frame of the pose is MAV_FRAME_LOCAL_FRD for ArduPilot, which accepts no other and reads it as north, east,
    down. For PX4 it is MAV_FRAME_LOCAL_NED: in LOCAL_FRD PX4 would add the distance from the origin times the yaw
    error, which is unknown here, to the position error."""
    q = quaternion_from_euler(attitude)
    velocity_cov = [0.0] * 21
    velocity_cov[_XX] = velocity_cov[_YY] = velocity_cov[_ZZ] = gps.speed_accuracy_mps**2
    return mavlink.MAVLink_odometry_message(
        gps.t_ns // 1000,
        mavlink.MAV_FRAME_LOCAL_FRD if ardupilot else mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        *position_ned_m(gps, origin, ardupilot=ardupilot),
        q,
        *rotate_to_body(q, (gps.vn_mps, gps.ve_mps, gps.vd_mps)),
        math.nan,  # angular rates are not sent: the autopilot's gyroscopes are better
        math.nan,
        math.nan,
        pose_covariance(gps, ardupilot=ardupilot),
        velocity_cov,
        reset_counter=gps.resets % RESET_COUNTER_MODULUS,
        estimator_type=mavlink.MAV_ESTIMATOR_TYPE_VISION,
        quality=QUALITY_GOOD,
    )


def vision_position(
    gps: GpsInput, origin: GeodeticPoint, attitude: VehicleAttitude, *, ardupilot: bool
) -> mavlink.MAVLink_vision_position_estimate_message:
    return mavlink.MAVLink_vision_position_estimate_message(
        gps.t_ns // 1000,
        *position_ned_m(gps, origin, ardupilot=ardupilot),
        attitude.roll_rad,
        attitude.pitch_rad,
        attitude.yaw_rad,
        pose_covariance(gps, ardupilot=ardupilot),
        reset_counter=gps.resets % RESET_COUNTER_MODULUS,
    )


def quaternion_from_euler(attitude: VehicleAttitude) -> tuple[float, float, float, float]:
    """-> (w, x, y, z), body to north, east, down; rotations in the order yaw, pitch, roll."""
    cr, sr = math.cos(attitude.roll_rad / 2), math.sin(attitude.roll_rad / 2)
    cp, sp = math.cos(attitude.pitch_rad / 2), math.sin(attitude.pitch_rad / 2)
    cy, sy = math.cos(attitude.yaw_rad / 2), math.sin(attitude.yaw_rad / 2)
    return (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def rotate_to_body(q: tuple[float, float, float, float], v: tuple[float, float, float]) -> tuple[float, float, float]:
    """Rotates ``v`` from north, east, down into body axes, by the inverse of ``q`` (w, x, y, z)."""
    w, (x, y, z) = q[0], (-q[1], -q[2], -q[3])
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (v[0] + w * tx + y * tz - z * ty, v[1] + w * ty + z * tx - x * tz, v[2] + w * tz + x * ty - y * tx)
