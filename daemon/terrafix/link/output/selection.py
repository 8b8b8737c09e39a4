"""Selects the messages that carry the position: those of the configuration, otherwise what the firmware supports."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.clock import NS_PER_S
from terrafix.core.config import OutputName
from terrafix.link.output import global_position, gps_input, odometry
from terrafix.link.output.odometry import GeodeticPoint, VehicleAttitude
from terrafix.messages import GpsInput

EXTERNAL_POSITION_PERIOD_NS = 5 * NS_PER_S  # ns; rare, because each one is a hard reset of the EKF [tuned]
EXTERNAL_POSITION_MAX_SIGMA_M = 30.0  # m, 1-sigma; the autopilot has no gate for it [tuned]
ORIGIN_REQUEST_PERIOD_NS = 3 * NS_PER_S  # ns between requests until the origin is known [tuned]
LOCAL_FRAME_OUTPUTS: tuple[OutputName, ...] = ("odometry", "vision_position")
DEFAULT_OUTPUTS: dict[str, tuple[OutputName, ...]] = {"px4": ("global_position",)}  # PX4 has no handler for GPS_INPUT


@dataclass(frozen=True)
class AutopilotState:
    """State of the autopilot at the time of a transmission."""

    firmware: str  # "ardupilot", "px4", ..., "none" before its first heartbeat
    sysid: int
    attitude: VehicleAttitude | None  # None: not known, or too old
    origin: GeodeticPoint | None


class PositionOutputs:
    """``messages`` for every GpsInput, ``requests`` regularly. ``missing_input``: what an output waits for, or ""."""

    def __init__(self, configured: list[OutputName], gps_id: int) -> None:
        self._configured = tuple(configured)
        self._gps_id = gps_id
        self._external_sent_ns: int | None = None
        self._origin_requested_ns: int | None = None
        self.missing_input = ""

    def names(self, firmware: str) -> tuple[OutputName, ...]:
        """The outputs in use."""
        return self._configured or DEFAULT_OUTPUTS.get(firmware, ("gps_input",))

    def messages(self, gps: GpsInput, autopilot: AutopilotState) -> Iterator[Any]:
        """The packets with this position; none from outputs that cannot state that there is no fix."""
        self.missing_input = ""
        for name in self.names(autopilot.firmware):
            match name:
                case "gps_input":
                    yield gps_input.encode(gps, self._gps_id)
                case "global_position" if gps.fix_type >= 3:
                    yield global_position.global_position_sensor(gps, autopilot.sysid)
                case "external_position":
                    yield from self._external_position(gps, autopilot)
                case "odometry" | "vision_position":
                    yield from self._local_frame(name, gps, autopilot)

    def requests(self, start: GeodeticPoint | None, autopilot: AutopilotState, now_ns: int) -> Iterator[Any]:
        """Requests for the origin of the autopilot's EKF, when an output needs it. From the second request on the
        start of the flight (``start``) is sent as the origin: an autopilot that never had a GPS position has none.
        ArduPilot ignores it when it has an origin."""
        if autopilot.origin is not None or not set(LOCAL_FRAME_OUTPUTS) & set(self.names(autopilot.firmware)):
            return
        if self._origin_requested_ns is not None and now_ns - self._origin_requested_ns < ORIGIN_REQUEST_PERIOD_NS:
            return
        first = self._origin_requested_ns is None
        self._origin_requested_ns = now_ns
        yield mavlink.MAVLink_command_long_message(
            autopilot.sysid,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
            mavlink.MAV_CMD_REQUEST_MESSAGE,
            0,
            mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
            *(0.0,) * 6,
        )
        if start is not None and not first:
            origin = (round(start.lat_deg * 1e7), round(start.lon_deg * 1e7), round(start.alt_amsl_m * 1e3))
            yield mavlink.MAVLink_set_gps_global_origin_message(autopilot.sysid, *origin)

    def _external_position(self, gps: GpsInput, autopilot: AutopilotState) -> Iterator[Any]:
        if gps.fix_type < 3 or gps.horiz_accuracy_m > EXTERNAL_POSITION_MAX_SIGMA_M:
            return
        if self._external_sent_ns is None or gps.t_ns - self._external_sent_ns >= EXTERNAL_POSITION_PERIOD_NS:
            self._external_sent_ns = gps.t_ns
            yield global_position.external_position_estimate(gps, autopilot.sysid)

    def _local_frame(self, name: OutputName, gps: GpsInput, autopilot: AutopilotState) -> Iterator[Any]:
        if autopilot.origin is None or autopilot.attitude is None:
            self.missing_input = f"{name} waits for the autopilot's " + ("attitude" if autopilot.origin else "origin")
            return
        if gps.fix_type >= 3:
            encode = odometry.odometry if name == "odometry" else odometry.vision_position
            ardupilot = autopilot.firmware != "px4"
            yield encode(gps, autopilot.origin, autopilot.attitude, ardupilot=ardupilot)
