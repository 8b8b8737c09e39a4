"""Which messages carry the position to the autopilot: those of the configuration, else what the firmware takes."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.config import OutputName
from terrafix.link.output import global_position, gps_input, odometry
from terrafix.link.output.odometry import Attitude, Place
from terrafix.messages import GpsInput

NS_PER_S = 1_000_000_000
EXTERNAL_NS = 5 * NS_PER_S  # a hard reset of the filter: seldom, and out of a position that is not rushed
EXTERNAL_ACCURACY_M = 30.0  # nothing gates it at the other end, so it has a gate here
ORIGIN_NS = 3 * NS_PER_S  # the origin is asked for this often until it is known
LOCAL: tuple[OutputName, ...] = ("odometry", "vision_position")
BY_FIRMWARE: dict[str, tuple[OutputName, ...]] = {"px4": ("global_position",)}  # it has no handler for GPS_INPUT


@dataclass(frozen=True)
class Autopilot:
    """What is known of the other side when something is sent."""

    firmware: str  # "ardupilot", "px4", ..., "none" while nobody was heard
    sysid: int
    attitude: Attitude | None  # None: not known, or old
    origin: Place | None


class Outputs:
    def __init__(self, configured: list[OutputName], gps_id: int) -> None:
        self._configured = tuple(configured)
        self._gps_id = gps_id
        self._external_ns: int | None = None
        self._asked_ns: int | None = None
        self.waits_for = ""  # what an output still needs before it can say anything

    def names(self, firmware: str) -> tuple[OutputName, ...]:
        return self._configured or BY_FIRMWARE.get(firmware, ("gps_input",))

    def messages(self, gps: GpsInput, autopilot: Autopilot) -> Iterator[Any]:
        self.waits_for = ""
        for name in self.names(autopilot.firmware):
            match name:
                case "gps_input":
                    yield gps_input.encode(gps, self._gps_id)
                case "global_position" if gps.fix_type >= 3:
                    yield global_position.global_position_sensor(gps, autopilot.sysid)
                case "external_position":
                    yield from self._external(gps, autopilot)
                case "odometry" | "vision_position":
                    yield from self._local(name, gps, autopilot)

    def requests(self, start: Place | None, autopilot: Autopilot, now_ns: int) -> Iterator[Any]:
        """What the outputs need of the autopilot: the origin of its filter. Where it has none, because no GPS ever told
        it one, ``start`` (of the flight) becomes it; ArduPilot ignores that while it has one."""
        if autopilot.origin is not None or not set(LOCAL) & set(self.names(autopilot.firmware)):
            return
        if self._asked_ns is not None and now_ns - self._asked_ns < ORIGIN_NS:
            return
        first = self._asked_ns is None
        self._asked_ns = now_ns
        yield mavlink.MAVLink_command_long_message(
            autopilot.sysid,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_CMD_REQUEST_MESSAGE,
            0,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
            *(0.0,) * 6,
        )
        if start is not None and not first:
            place = (round(start.lat_deg * 1e7), round(start.lon_deg * 1e7), round(start.alt_amsl_m * 1e3))
            yield mavlink.MAVLink_set_gps_global_origin_message(autopilot.sysid, *place)

    def _external(self, gps: GpsInput, autopilot: Autopilot) -> Iterator[Any]:
        if gps.fix_type < 3 or gps.horiz_accuracy_m > EXTERNAL_ACCURACY_M:
            return
        if self._external_ns is None or gps.t_ns - self._external_ns >= EXTERNAL_NS:
            self._external_ns = gps.t_ns
            yield global_position.external_position_estimate(gps, autopilot.sysid)

    def _local(self, name: OutputName, gps: GpsInput, autopilot: Autopilot) -> Iterator[Any]:
        if autopilot.origin is None or autopilot.attitude is None:
            self.waits_for = f"{name} waits for the autopilot's " + ("attitude" if autopilot.origin else "origin")
            return
        if gps.fix_type >= 3:
            encode = odometry.odometry if name == "odometry" else odometry.vision_position
            ardupilot = autopilot.firmware != "px4"
            yield encode(gps, autopilot.origin, autopilot.attitude, ardupilot=ardupilot)
