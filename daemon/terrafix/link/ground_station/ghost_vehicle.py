"""The ghost vehicle: our position as a second vehicle on the ground station's map, beside that of the autopilot.

It is sent on links to ground stations only, never to an autopilot. It is a display and accepts no commands."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.ground_station.position_prior import COMMAND_TYPES, command_ack
from terrafix.messages import GpsInput

GHOST_PERIOD_NS = 500_000_000  # ns between positions; enough for a map on a screen [tuned]
MIN_COURSE_SPEED_MPS = 1.0  # m/s; below it the course over ground is not defined [tuned]
HEADING_UNKNOWN = 65535  # [spec: MAVLink GLOBAL_POSITION_INT hdg]
UNKNOWN_U16 = 65535  # [spec: MAVLink GPS_RAW_INT vel, cog]


class GhostVehicle:
    """One system id. ``position`` for every GpsInput, ``heartbeat`` once a second, ``reply`` for received messages."""

    def __init__(self, sysid: int) -> None:
        self.sysid = sysid
        self._next_ns = 0

    def sender(self) -> mavlink.MAVLink:
        """Packs messages as component 1, because ground stations show only that one as a vehicle."""
        return mavlink.MAVLink(None, srcSystem=self.sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)

    def heartbeat(self, vehicle_type: int, *, has_fix: bool) -> mavlink.MAVLink_heartbeat_message:
        """``vehicle_type``: MAV_TYPE of the real vehicle."""
        state = mavlink.MAV_STATE_ACTIVE if has_fix else mavlink.MAV_STATE_CRITICAL
        return mavlink.MAVLink_heartbeat_message(vehicle_type, mavlink.MAV_AUTOPILOT_GENERIC, 0, 0, state, 3)

    def position(self, gps: GpsInput) -> Iterator[Any]:
        """GPS_RAW_INT and, with a fix, GLOBAL_POSITION_INT, twice a second. Without a fix GPS_RAW_INT has fix type 1
        and the mark on the map stays at its last position."""
        if gps.t_ns < self._next_ns:
            return
        self._next_ns = gps.t_ns + GHOST_PERIOD_NS
        has_fix = gps.fix_type >= 3
        lat_lon_alt = (round(gps.lat_deg * 1e7), round(gps.lon_deg * 1e7), round(gps.alt_amsl_m * 1e3))
        speed_mps = math.hypot(gps.vn_mps, gps.ve_mps)
        course_cdeg = round(math.degrees(math.atan2(gps.ve_mps, gps.vn_mps)) * 100) % 36_000
        h_acc, v_acc, s_acc = (
            round(1e3 * a) if has_fix else 0
            for a in (gps.horiz_accuracy_m, gps.vert_accuracy_m, gps.speed_accuracy_mps)
        )
        yield mavlink.MAVLink_gps_raw_int_message(
            gps.t_ns // 1000,
            gps.fix_type,
            *(lat_lon_alt if has_fix else (0, 0, 0)),
            round(gps.hdop * 100),
            round(gps.vdop * 100),
            min(UNKNOWN_U16 - 1, round(speed_mps * 100)) if has_fix else UNKNOWN_U16,
            course_cdeg if has_fix else UNKNOWN_U16,
            gps.satellites_visible,
            h_acc=h_acc,
            v_acc=v_acc,
            vel_acc=s_acc,
        )
        if has_fix:
            yield mavlink.MAVLink_global_position_int_message(
                gps.t_ns // 1_000_000 % 2**32,
                *lat_lon_alt,
                0,  # height above home: this vehicle has no home
                *(max(-32768, min(32767, round(v * 100))) for v in (gps.vn_mps, gps.ve_mps, gps.vd_mps)),
                course_cdeg if speed_mps >= MIN_COURSE_SPEED_MPS else HEADING_UNKNOWN,
            )

    def reply(self, message: Any) -> Iterator[Any]:
        """Rejects every command for this vehicle at once, so that a ground station does not repeat it."""
        if message.get_type() in COMMAND_TYPES and message.target_system == self.sysid:
            yield command_ack(message, mavlink.MAV_RESULT_UNSUPPORTED)
