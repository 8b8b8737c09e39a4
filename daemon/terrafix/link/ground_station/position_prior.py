"""Position hints from ground stations (AC-6): the messages that carry them, and the replies.

Two messages are accepted, because ground stations offer them on their maps (docs/autopilot.md):
MAV_CMD_EXTERNAL_POSITION_ESTIMATE addressed to our component (MAVProxy: Set Position), and SET_GPS_GLOBAL_ORIGIN
(Mission Planner: Set EKF Origin Here; QGroundControl: Set Estimator Origin). The second has no target component, so
that an autopilot forwards it to us; the autopilot keeps the origin that it has."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.gate import SIGMAS_95
from terrafix.messages import PositionHint

DEFAULT_RADIUS_M = 5000.0  # m; radius of a hint without accuracy [spec: requirement AC-6]
MIN_RADIUS_M = 100.0  # m; accuracy of a position that is picked on a map by hand [tuned]
# ns; the same position within this time is one hint that was repeated, or received on two links. [tuned]
DUPLICATE_NS = 3_000_000_000
GLOBAL_FRAMES = {
    mavlink.MAV_FRAME_GLOBAL,
    mavlink.MAV_FRAME_GLOBAL_INT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT,
    mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT,
}
NOT_A_POSITION = "Terrafix: hint is no position, not used"
COMMAND_TYPES = ("COMMAND_LONG", "COMMAND_INT")


class HintReceiver:
    """``on_message`` for every message of a link; it yields PositionHint, and packets to reply with."""

    def __init__(self, sysid: int, compid: int) -> None:
        """``sysid``, ``compid``: our own system and component."""
        self._sysid, self._compid = sysid, compid
        self._stations: set[tuple[int, int]] = set()  # (system, component) of senders with a ground station's heartbeat
        self._last: tuple[float, float, int] | None = None

    def on_message(self, message: Any, now_ns: int, systems: set[int]) -> Iterator[PositionHint | Any]:
        """``systems``: further system ids of this vehicle: that of the autopilot and that of the ghost vehicle."""
        kind = message.get_type()
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if kind == "HEARTBEAT" and message.type == mavlink.MAV_TYPE_GCS:
            self._stations.add(sender)
        elif kind == "SET_GPS_GLOBAL_ORIGIN":
            # Companion computers send it too, for another purpose: a hint comes from a ground station with an operator.
            if sender in self._stations and message.target_system in systems | {self._sysid}:
                lat_deg, lon_deg = message.latitude / 1e7, message.longitude / 1e7
                yield from self._hint(lat_deg, lon_deg, DEFAULT_RADIUS_M, sender[0], now_ns)
        elif kind in COMMAND_TYPES and message.target_system == self._sysid:
            yield from self._command(message, sender, now_ns)

    def _command(self, message: Any, sender: tuple[int, int], now_ns: int) -> Iterator[PositionHint | Any]:
        if message.command != mavlink.MAV_CMD_EXTERNAL_POSITION_ESTIMATE:
            if message.target_component == self._compid:
                yield command_ack(message, mavlink.MAV_RESULT_UNSUPPORTED)
            return
        if message.target_component not in (0, self._compid):
            return  # addressed to the autopilot
        if sender not in self._stations:  # only an operator may send a hint
            yield command_ack(message, mavlink.MAV_RESULT_DENIED)
            return
        lat_deg, lon_deg = math.nan, math.nan
        if message.get_type() == "COMMAND_LONG":
            lat_deg, lon_deg = message.param5, message.param6
        elif message.frame in GLOBAL_FRAMES:
            lat_deg, lon_deg = message.x / 1e7, message.y / 1e7
        sigma_m = message.param3
        radius_m = SIGMAS_95 * sigma_m if math.isfinite(sigma_m) and sigma_m > 0.0 else DEFAULT_RADIUS_M
        replies = list(self._hint(lat_deg, lon_deg, max(MIN_RADIUS_M, radius_m), sender[0], now_ns))
        valid = is_valid_position(lat_deg, lon_deg)
        yield command_ack(message, mavlink.MAV_RESULT_ACCEPTED if valid else mavlink.MAV_RESULT_DENIED)
        yield from replies

    def _hint(
        self, lat_deg: float, lon_deg: float, radius_m: float, system: int, now_ns: int
    ) -> Iterator[PositionHint | Any]:
        if not is_valid_position(lat_deg, lon_deg):
            yield mavlink.MAVLink_statustext_message(mavlink.MAV_SEVERITY_WARNING, NOT_A_POSITION.encode())
            return
        repeated = (
            self._last is not None and self._last[:2] == (lat_deg, lon_deg) and now_ns - self._last[2] < DUPLICATE_NS
        )
        self._last = (lat_deg, lon_deg, now_ns)
        if not repeated:
            source = f"ground station {system}"
            yield PositionHint(t_ns=now_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=radius_m, source=source)


def is_valid_position(lat_deg: float, lon_deg: float) -> bool:
    """Whether this is a position on the globe. (0, 0) is not accepted: it is the value of unset fields."""
    known = math.isfinite(lat_deg) and math.isfinite(lon_deg) and (lat_deg, lon_deg) != (0.0, 0.0)
    return known and abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0


def command_ack(command: Any, result: int) -> mavlink.MAVLink_command_ack_message:
    """COMMAND_ACK to the sender of ``command``. ``result``: MAV_RESULT."""
    return mavlink.MAVLink_command_ack_message(
        command.command, result, 0, 0, command.get_srcSystem(), command.get_srcComponent()
    )
