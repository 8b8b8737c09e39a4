"""Telemetry messages of the simulated autopilot, from its readings and its navigation solution."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.geodesy import LocalFrame
from terrafix.core.mavlink.gimbal import IN_EARTH, YAW_LOCK
from terrafix_lab.sim.autopilot.navigation.gps import GpsInstance
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.interfaces import Navigation, Readings

GRAVITY_MPS2 = 9.80665
RATES_HZ = {  # default rates; 0: only on request
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 4.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 3.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 2.0,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 2.0,
    mavlink.MAVLINK_MSG_ID_RAW_IMU: 2.0,
    mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE: 2.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_AIRSPEED: 2.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 0.1,
    mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS: 0.0,
}
HEADING_UNKNOWN = 65535
_UINT16_MAX, _UINT32_MAX = 65535, 0xFFFF_FFFF
DOP_UNKNOWN = 9999
# International Standard Atmosphere below 11 km (ICAO Doc 7488): pressure at height.
ISA_HPA, ISA_M, ISA_EXPONENT = 1013.25, 44330.77, 5.25588
SEA_LEVEL_KGPM3 = 1.225
AIR_CDEGC = 1500  # temperature of the sensor, centidegrees


@dataclass(frozen=True)
class Snapshot:
    """Inputs of all messages; the truth is not among them."""

    boot_ns: int
    unix_us: int  # 0: not known from any receiver
    kind: Kind
    frame: LocalFrame
    home_amsl_m: float
    readings: Readings
    navigation: Navigation | None
    gps: Sequence[GpsInstance | None]
    armed: bool
    ekf_flags: int
    velocity_variance: float  # test ratios, 1 at the gate
    position_variance: float

    @property
    def boot_ms(self) -> int:
        return (self.boot_ns // 1_000_000) & 0xFFFF_FFFF


def message(message_id: int, now: Snapshot) -> Any | None:
    """Returns the message ``message_id`` of ``RATES_HZ``; None when there is no data for it."""
    match message_id:
        case mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return _heartbeat(now)
        case mavlink.MAVLINK_MSG_ID_ATTITUDE:
            r, rates = now.readings, now.readings.gyro_b_radps
            return mavlink.MAVLink_attitude_message(
                now.boot_ms, r.roll_rad, r.pitch_rad, math.remainder(r.yaw_rad, math.tau), *map(float, rates)
            )
        case mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
            return _global_position(now)
        case mavlink.MAVLINK_MSG_ID_VFR_HUD:
            return _vfr_hud(now)
        case mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
            return _gps_raw(now, 0)
        case mavlink.MAVLINK_MSG_ID_GPS2_RAW:
            return _gps_raw(now, 1)
        case mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT:
            return mavlink.MAVLink_ekf_status_report_message(
                now.ekf_flags, now.velocity_variance, now.position_variance, 0.05, 0.05, 0.0
            )
        case mavlink.MAVLINK_MSG_ID_RAW_IMU:
            return _raw_imu(now)
        case mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE:
            hpa = ISA_HPA * (1.0 - now.readings.baro_amsl_m / ISA_M) ** ISA_EXPONENT
            return mavlink.MAVLink_scaled_pressure_message(now.boot_ms, hpa, 0.0, AIR_CDEGC)
        case mavlink.MAVLINK_MSG_ID_AIRSPEED:
            return _airspeed(now)
        case mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
            return mavlink.MAVLink_system_time_message(now.unix_us, now.boot_ms)
        case mavlink.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS:
            q, still = now.readings.gimbal, (0.0, 0.0, 0.0)
            flags = YAW_LOCK | IN_EARTH
            return q and mavlink.MAVLink_gimbal_device_attitude_status_message(0, 0, now.boot_ms, flags, q, *still, 0)
        case _:
            return mavlink.MAVLink_timesync_message(0, now.boot_ns)


def _heartbeat(now: Snapshot) -> Any:
    kind = mavlink.MAV_TYPE_FIXED_WING if now.kind is Kind.PLANE else mavlink.MAV_TYPE_QUADROTOR
    mode = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if now.armed else 0)
    state = mavlink.MAV_STATE_ACTIVE if now.armed else mavlink.MAV_STATE_STANDBY
    return mavlink.MAVLink_heartbeat_message(kind, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, mode, 0, state, 3)


def _global_position(now: Snapshot) -> Any:
    """Without a position, latitude and longitude are 0 and the height is the barometer's."""
    lat = lon = 0
    up_m, ve, vn, vu = now.readings.baro_amsl_m, 0.0, 0.0, 0.0
    if now.navigation is not None:
        lat, lon = (round(v * 1e7) for v in now.frame.to_wgs84(*map(float, now.navigation.p_b_in_w_m[:2])))
        up_m = float(now.navigation.p_b_in_w_m[2])
        ve, vn, vu = (float(v) for v in now.navigation.velocity_enu_mps)
    heights = (_int32(up_m * 1e3), _int32((up_m - now.home_amsl_m) * 1e3))
    speeds = (_int16(vn * 100), _int16(ve * 100), _int16(-vu * 100))
    return mavlink.MAVLink_global_position_int_message(now.boot_ms, lat, lon, *heights, *speeds, HEADING_UNKNOWN)


def _vfr_hud(now: Snapshot) -> Any:
    v = now.navigation.velocity_enu_mps if now.navigation is not None else (0.0, 0.0, 0.0)
    over_ground = math.hypot(float(v[0]), float(v[1]))
    air = now.readings.airspeed_mps
    heading = round(math.degrees(now.readings.yaw_rad)) % 360
    speeds = (over_ground if air is None else air, over_ground)
    return mavlink.MAVLink_vfr_hud_message(*speeds, heading, 0, now.readings.baro_amsl_m, float(v[2]))


def _airspeed(now: Snapshot) -> Any | None:
    """AIRSPEED of a sensor; raw pressure in Pa: the dynamic pressure at sea level for that speed, as in ArduPilot."""
    air_mps = now.readings.airspeed_mps
    if air_mps is None:
        return None
    return mavlink.MAVLink_airspeed_message(0, air_mps, AIR_CDEGC, 0.5 * SEA_LEVEL_KGPM3 * air_mps**2, 0)


def _gps_raw(now: Snapshot, instance: int) -> Any | None:
    gps = now.gps[instance]
    if gps is None:
        return None
    fix = gps.fix if gps.has_fix() else None
    if fix is None:
        place, speed, h_mm, v_mm = (0, 0, 0), 0, 0, 0
    else:
        place = (round(fix.lat_deg * 1e7), round(fix.lon_deg * 1e7), _int32(fix.alt_amsl_m * 1e3))
        speed = min(_UINT16_MAX, round(100 * math.hypot(*fix.velocity_ned_mps[:2])))
        h_mm, v_mm = (min(_UINT32_MAX, round(1e3 * (a or 0.0))) for a in (fix.horizontal_m, fix.vertical_m))
    dop = DOP_UNKNOWN if fix is None else min(DOP_UNKNOWN, round(fix.hdop * 100))
    head = (now.boot_ns // 1000, gps.fix_type, *place, dop, DOP_UNKNOWN, speed, 0, gps.satellites)
    if instance == 0:
        return mavlink.MAVLink_gps_raw_int_message(*head, h_acc=h_mm, v_acc=v_mm)
    return mavlink.MAVLink_gps2_raw_message(*head, 0, 0, h_acc=h_mm, v_acc=v_mm)


def _raw_imu(now: Snapshot) -> Any:
    """Units of ArduPilot's RAW_IMU: milli-g and milliradians per second, clipped to 16 bits."""
    milli_g = (_int16(float(a) / GRAVITY_MPS2 * 1e3) for a in now.readings.accel_b_mps2)
    milli_rad = (_int16(float(w) * 1e3) for w in now.readings.gyro_b_radps)
    return mavlink.MAVLink_raw_imu_message(now.boot_ns // 1000, *milli_g, *milli_rad, 0, 0, 0)


def _int16(value: float) -> int:
    """Rounds and clips: a vehicle released in mid-air exceeds the range of the sensor."""
    return max(-32768, min(32767, round(value)))


def _int32(value: float) -> int:
    """Rounds and clips: heights in mm, of a GPS_INPUT that states any float, or of a filter that diverges."""
    return max(-0x8000_0000, min(0x7FFF_FFFF, round(value)))
