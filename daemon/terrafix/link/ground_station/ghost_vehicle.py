"""Our position as a second vehicle on the ground station's map, beside the one that the autopilot believes in.

Sent on links to ground stations alone: an autopilot never hears it. It is there to look at: it takes no commands."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.link.ground_station.position_prior import COMMANDS, acknowledged
from terrafix.messages import GpsInput

PERIOD_NS = 500_000_000  # of the position; a map on a screen needs no more
SLOW_S = 1.0  # below this speed the way flown has no direction
HEADING_UNKNOWN = 65535
UNKNOWN_U16 = 65535


class VehicleView:
    """One system id. ``position`` at every GpsInput, ``heartbeat`` once a second, ``answer`` to what it is sent."""

    def __init__(self, sysid: int) -> None:
        self.sysid = sysid
        self._next_ns = 0

    def sender(self) -> mavlink.MAVLink:
        """To pack with: ground stations make a vehicle of component 1 only."""
        return mavlink.MAVLink(None, srcSystem=self.sysid, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)

    def heartbeat(self, vehicle_type: int, *, good: bool) -> mavlink.MAVLink_heartbeat_message:
        """``vehicle_type``: MAV_TYPE of the real one; ``good``: there is a fix."""
        state = mavlink.MAV_STATE_ACTIVE if good else mavlink.MAV_STATE_CRITICAL
        return mavlink.MAVLink_heartbeat_message(vehicle_type, mavlink.MAV_AUTOPILOT_GENERIC, 0, 0, state, 3)

    def position(self, gps: GpsInput) -> Iterator[Any]:
        """Twice a second. Without a fix there is no position, and GPS_RAW_INT says so: the mark on the map is old."""
        if gps.t_ns < self._next_ns:
            return
        self._next_ns = gps.t_ns + PERIOD_NS
        good = gps.fix_type >= 3
        place = (round(gps.lat_deg * 1e7), round(gps.lon_deg * 1e7), round(gps.alt_amsl_m * 1e3))
        speed_mps = math.hypot(gps.vn_mps, gps.ve_mps)
        course_cdeg = round(math.degrees(math.atan2(gps.ve_mps, gps.vn_mps)) * 100) % 36_000
        h_acc, v_acc, s_acc = (
            round(1e3 * a) if good else 0 for a in (gps.horiz_accuracy_m, gps.vert_accuracy_m, gps.speed_accuracy_mps)
        )
        yield mavlink.MAVLink_gps_raw_int_message(
            gps.t_ns // 1000,
            gps.fix_type,
            *(place if good else (0, 0, 0)),
            round(gps.hdop * 100),
            round(gps.vdop * 100),
            min(UNKNOWN_U16 - 1, round(speed_mps * 100)) if good else UNKNOWN_U16,
            course_cdeg if good else UNKNOWN_U16,
            gps.satellites_visible,
            h_acc=h_acc,
            v_acc=v_acc,
            vel_acc=s_acc,
        )
        if good:
            yield mavlink.MAVLink_global_position_int_message(
                gps.t_ns // 1_000_000 % 2**32,
                *place,
                0,  # above home: this vehicle has none
                *(max(-32768, min(32767, round(v * 100))) for v in (gps.vn_mps, gps.ve_mps, gps.vd_mps)),
                course_cdeg if speed_mps >= SLOW_S else HEADING_UNKNOWN,
            )

    def answer(self, message: Any) -> Iterator[Any]:
        """No command is for it: said at once, so that a ground station does not ask again and again."""
        if message.get_type() in COMMANDS and message.target_system == self.sysid:
            yield acknowledged(message, mavlink.MAV_RESULT_UNSUPPORTED)
