"""A coarse position from the ground (AC-6): what ground stations can send as one, and what they are answered.

Two ways, chosen by what ground stations have on their maps (docs/autopilot.md): MAV_CMD_EXTERNAL_POSITION_ESTIMATE
addressed to our component (MAVProxy: Set Position), and SET_GPS_GLOBAL_ORIGIN (Mission Planner: Set EKF Origin Here;
QGroundControl: Set Estimator Origin). The second has no component as its target, so that an autopilot hands it on to
us; it keeps the origin that it has."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.messages import PositionHint

RADIUS_M = 5000.0  # of a hint that states no accuracy (AC-6)
LEAST_RADIUS_M = 100.0  # a finger on a map is no better
RADIUS_BY_SIGMA = math.sqrt(5.991)  # radius that holds 95 %, by a 1-sigma per axis (chi-square, 2 degrees of freedom)
SAME_NS = 3_000_000_000  # the same place within this time is one hint, sent again or heard on two links
GLOBAL_FRAMES = {
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
}
NOT_A_POSITION = "Terrafix: hint is no position, not used"
COMMANDS = ("COMMAND_LONG", "COMMAND_INT")


class Hints:
    """``take`` every message of a link: PositionHint comes out, and packets to answer with."""

    def __init__(self, sysid: int, compid: int) -> None:
        """Our own system and component."""
        self._sysid, self._compid = sysid, compid
        self._stations: set[tuple[int, int]] = set()  # (system, component) of those who said to be a ground station
        self._last: tuple[float, float, int] | None = None

    def take(self, message: Any, now_ns: int, systems: set[int]) -> Iterator[PositionHint | Any]:
        """``systems``: ids that mean this vehicle besides ours: the autopilot's, and that of our view of it."""
        kind = message.get_type()
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS:
            self._stations.add(sender)
        elif kind == "SET_GPS_GLOBAL_ORIGIN":
            # Companions send it too, and not as a hint: from a ground station there is a person behind it.
            if sender in self._stations and message.target_system in systems | {self._sysid}:
                lat_deg, lon_deg = message.latitude / 1e7, message.longitude / 1e7
                yield from self._hint(lat_deg, lon_deg, RADIUS_M, sender[0], now_ns)
        elif kind in COMMANDS and message.target_system == self._sysid:
            yield from self._command(message, sender, now_ns)

    def _command(self, message: Any, sender: tuple[int, int], now_ns: int) -> Iterator[PositionHint | Any]:
        if message.command != mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            if message.target_component == self._compid:
                yield acknowledged(message, mavlink.MAV_RESULT_UNSUPPORTED)
            return
        if message.target_component not in (0, self._compid):
            return  # the autopilot's
        if sender not in self._stations:  # a person gives a hint; nobody else addresses us
            yield acknowledged(message, mavlink.MAV_RESULT_DENIED)
            return
        lat_deg, lon_deg = math.nan, math.nan
        if message.get_type() == "COMMAND_LONG":
            lat_deg, lon_deg = message.param5, message.param6
        elif message.frame in GLOBAL_FRAMES:
            lat_deg, lon_deg = message.x / 1e7, message.y / 1e7
        sigma_m = message.param3
        radius_m = RADIUS_BY_SIGMA * sigma_m if math.isfinite(sigma_m) and sigma_m > 0.0 else RADIUS_M
        said = list(self._hint(lat_deg, lon_deg, max(LEAST_RADIUS_M, radius_m), sender[0], now_ns))
        good = is_place(lat_deg, lon_deg)
        yield acknowledged(message, mavlink.MAV_RESULT_ACCEPTED if good else mavlink.MAV_RESULT_DENIED)
        yield from said

    def _hint(
        self, lat_deg: float, lon_deg: float, radius_m: float, system: int, now_ns: int
    ) -> Iterator[PositionHint | Any]:
        if not is_place(lat_deg, lon_deg):
            yield mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, NOT_A_POSITION.encode())
            return
        again = self._last is not None and self._last[:2] == (lat_deg, lon_deg) and now_ns - self._last[2] < SAME_NS
        self._last = (lat_deg, lon_deg, now_ns)
        if not again:
            source = f"ground station {system}"
            yield PositionHint(t_ns=now_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=radius_m, source=source)


def is_place(lat_deg: float, lon_deg: float) -> bool:
    """0, 0 is what an unset field says."""
    known = math.isfinite(lat_deg) and math.isfinite(lon_deg) and (lat_deg, lon_deg) != (0.0, 0.0)
    return known and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0


def acknowledged(command: Any, result: int) -> mavlink.MAVLink_command_ack_message:
    """To whoever sent it."""
    return mavlink.MAVLink_command_ack_message(
        command.command, result, 0, 0, command.get_srcSystem(), command.get_srcComponent()
    )
