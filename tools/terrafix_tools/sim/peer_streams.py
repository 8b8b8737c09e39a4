"""What the autopilot peer says about itself: attitude, height, its filter's position; with seeded sensor noise."""

import random
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix_tools.sim.peer_course import PeerState
from terrafix_tools.sim.peer_filter import PositionFilter
from terrafix_tools.sim.peer_gps import GpsDriver

RATES_HZ = {  # before anybody asks
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 4.0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 3.0,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 2.0,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 2.0,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 0.1,
}
ATTITUDE_NOISE_RAD, YAW_BIAS_RAD, HEIGHT_NOISE_M = 0.003, 0.02, 0.3  # 1-sigma
HEADING_UNKNOWN = 65535
DOP_UNKNOWN = 9999


class PeerStreams:
    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        self._yaw_bias_rad = self._rng.gauss(0.0, YAW_BIAS_RAD)

    def message(
        self,
        message_id: int,
        boot_ns: int,
        home_m: float,
        truth: PeerState,
        position: PositionFilter | None,
        gps: GpsDriver,
    ) -> Any:
        """The next message of one of ``RATES_HZ``. The true position is in none of them."""
        boot_ms = boot_ns // 1_000_000
        height_m = truth.amsl_m - home_m + self._rng.gauss(0.0, HEIGHT_NOISE_M)
        lat_deg, lon_deg = position.position() if position else (0.0, 0.0)
        vn, ve = position.velocity() if position else (0.0, 0.0)
        lat, lon = round(lat_deg * 1e7), round(lon_deg * 1e7)
        match message_id:
            case mavlink.MAVLINK_MSG_ID_HEARTBEAT:
                kind, firmware = mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
                return mavlink.MAVLink_heartbeat_message(kind, firmware, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)
            case mavlink.MAVLINK_MSG_ID_ATTITUDE:
                return self._attitude(boot_ms, truth)
            case mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT:
                heights = (round((height_m + home_m) * 1e3), round(height_m * 1e3))
                speeds = (round(vn * 100), round(ve * 100), round(truth.vd_mps * 100))
                return mavlink.MAVLink_global_position_int_message(
                    boot_ms, lat, lon, *heights, *speeds, HEADING_UNKNOWN
                )
            case mavlink.MAVLINK_MSG_ID_VFR_HUD:
                speed = (vn**2 + ve**2) ** 0.5
                return mavlink.MAVLink_vfr_hud_message(speed, speed, 0, 0, height_m + home_m, -truth.vd_mps)
            case mavlink.MAVLINK_MSG_ID_GPS_RAW_INT:
                return mavlink.MAVLink_gps_raw_int_message(
                    boot_ms * 1000, gps.fix_type, *gps.lat_lon_e7, 0, DOP_UNKNOWN, DOP_UNKNOWN, 0, 0, gps.satellites
                )
            case mavlink.MAVLINK_MSG_ID_SYSTEM_TIME:
                return mavlink.MAVLink_system_time_message(0, boot_ms)  # no wall time: no receiver ever gave it one
            case _:
                return mavlink.MAVLink_timesync_message(0, boot_ns)

    def _attitude(self, boot_ms: int, truth: PeerState) -> Any:
        roll, pitch, yaw = (self._rng.gauss(0.0, ATTITUDE_NOISE_RAD) for _ in range(3))
        yaw += truth.yaw_rad + self._yaw_bias_rad
        return mavlink.MAVLink_attitude_message(boot_ms, truth.roll_rad + roll, truth.pitch_rad + pitch, yaw, 0, 0, 0)
