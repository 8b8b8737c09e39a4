"""Records a SITL flight: the simulator's true state, and the autopilot's position and status.

The observer has its own MAVLink port and requests streams there; it sends nothing that influences the flight.
"""

import bisect
import math
import socket
import statistics
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix.core.errors import LinkError

DATAGRAM_MAX = 4096
SO_TIMESTAMPNS = 35  # Linux, asm-generic/socket.h; Python has no name for it
TIMESPEC = struct.Struct("@ll")
RECEIVE_TIMEOUT_S = 0.1  # receive time-out, after which the stop request is checked
OFFSET_SAMPLES = 80  # number of clock offsets in the median: two seconds
CYCLE_NS = 1_000_000  # messages of one firmware loop cycle arrive in a burst within this time
REQUEST_INTERVAL_S = 2.0  # request interval: requests are UDP datagrams, which may arrive before the firmware listens
SILENT_S = 3.0  # without a message of a requested stream: the firmware was restarted
RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 40,  # a plane's 50 Hz loop sends a stream at most at 80 % of that rate
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 40,  # same rate: it arrives right before SIM_STATE, which has no time stamp
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 5,
    mavlink.MAVLINK_MSG_ID_GPS2_RAW: 5,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5,
}
ONCE = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
# Last byte of flight_sw_version (MAVLink common.xml, FIRMWARE_VERSION_TYPE)
STAGES = {0: "-dev", 64: "-alpha", 128: "-beta", 192: "-rc", 255: ""}
SYSID, COMPID = 1, mavlink.MAV_COMP_ID_ONBOARD_COMPUTER2
AUTOPILOT = mavlink.MAV_COMP_ID_AUTOPILOT1


@dataclass(frozen=True)
class Truth:
    """True state of the simulated vehicle; ``t_ns`` is on the monotonic clock (SimulatedTime)."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float


@dataclass(frozen=True)
class StatusTextRecord:
    """A received STATUSTEXT; ``t_ns`` is the time of arrival."""

    t_ns: int
    severity: int
    text: str


@dataclass(frozen=True)
class PositionRecord:
    """Horizontal position of the autopilot's filter (GLOBAL_POSITION_INT)."""

    t_ns: int
    lat_deg: float
    lon_deg: float


class SimulatedTime:
    """Maps the firmware's clock, which drives the simulation, to the monotonic clock of this machine.

    The firmware computes ahead, then waits, and is late when the machine is busy: messages arrive up to some 20 ms
    away from their nominal time, in which a plane flies half a metre. Images rendered at the arrival times would jump
    by as much, which no real camera does. The offset between the clocks is the median over the last seconds.
    """

    def __init__(self) -> None:
        self._offsets_ns: deque[int] = deque(maxlen=OFFSET_SAMPLES)
        self._boot_ms, self._arrival_ns = 0, 0  # boot time and arrival of the last SYSTEM_TIME

    def update(self, boot_ms: int, arrival_ns: int) -> None:
        """Adds the clock offset of a SYSTEM_TIME. After a reboot of the firmware the offset is another one."""
        if boot_ms < self._boot_ms:
            self._offsets_ns.clear()
        self._offsets_ns.append(arrival_ns - boot_ms * 1_000_000)
        self._boot_ms, self._arrival_ns = boot_ms, arrival_ns

    def monotonic_ns(self, boot_ms: int) -> int | None:
        """Returns the time on the monotonic clock; None before the first SYSTEM_TIME."""
        return boot_ms * 1_000_000 + round(statistics.median(self._offsets_ns)) if self._offsets_ns else None

    def current_cycle_ns(self, arrival_ns: int) -> int | None:
        """Returns the time of a message without time stamp: that of the SYSTEM_TIME of the same firmware cycle, else
        None.
        """
        return self.monotonic_ns(self._boot_ms) if arrival_ns - self._arrival_ns < CYCLE_NS else None


@dataclass
class FlightLog:
    """Everything that was received, in order of arrival. Tuples are ``(t_ns, value)``. ``t_ns`` is on the firmware's
    clock (mapped) where the message has one, else the time of arrival.
    """

    truth: list[Truth] = field(default_factory=list)
    texts: list[StatusTextRecord] = field(default_factory=list)
    positions: list[PositionRecord] = field(default_factory=list)
    fix_types: tuple[list[tuple[int, int]], list[tuple[int, int]]] = field(default_factory=lambda: ([], []))  # GPS 1, 2
    gps_healthy: list[tuple[int, bool]] = field(default_factory=list)  # SYS_STATUS: health of the GPS in use
    ekf_flags: list[tuple[int, int]] = field(default_factory=list)
    version: str = ""  # of the firmware, with the first characters of its commit
    armed: list[tuple[int, bool]] = field(default_factory=list)  # from the autopilot's heartbeats
    time: SimulatedTime = field(default_factory=SimulatedTime)


class Observer:
    """A context manager; ``log`` is filled until exit. It may be read from any thread, since the lists only grow."""

    def __init__(self, port: int) -> None:
        """Raises LinkError when the port is taken."""
        self.log = FlightLog()
        self._mav = mavlink.MAVLink(None, srcSystem=SYSID, srcComponent=COMPID)
        self._mav.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise LinkError(f"cannot listen on UDP port {port} ({error.strerror}); choose another --port") from None
        self._socket.settimeout(RECEIVE_TIMEOUT_S)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._seen_s: dict[int, float] = {}  # message id -> time of the last one
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="sitl-observer", daemon=True)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def truth_at(self, t_ns: int) -> Truth | None:
        """Interpolates the true state at ``t_ns``; None before the first and after the last state."""
        states = self.log.truth
        after = bisect.bisect_left(states, t_ns, key=lambda state: state.t_ns)
        if after == len(states) or (after == 0 and states[0].t_ns != t_ns):
            return None
        return states[after] if after == 0 else interpolate(states[after - 1], states[after], t_ns)

    def __enter__(self) -> "Observer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        requested_s = -REQUEST_INTERVAL_S
        while not self._stopping.is_set():
            try:
                packet, extra, _, sender = self._socket.recvmsg(DATAGRAM_MAX, socket.CMSG_SPACE(TIMESPEC.size))
            except (TimeoutError, ConnectionRefusedError):
                continue
            now_ns = arrival_ns(extra)
            for message in self._mav.parse_buffer(packet) or []:
                record(self.log, message, now_ns)
                self._seen_s[message.get_msgId()] = time.monotonic()
            if time.monotonic() - requested_s > REQUEST_INTERVAL_S and (missing := self._missing()):
                requested_s = time.monotonic()
                self._request_messages(missing, sender)

    def _missing(self) -> set[int]:
        """-> what has not arrived, or, since a reboot of the firmware, no longer arrives."""
        since_s = time.monotonic() - SILENT_S
        return {
            kind
            for kind in (*RATES_HZ, ONCE)
            if kind not in self._seen_s or (kind != ONCE and self._seen_s[kind] < since_s)
        }

    def _request_messages(self, kinds: set[int], whom: tuple[str, int]) -> None:
        for kind in sorted(kinds):
            command, interval_us = mavlink.MAV_CMD_REQUEST_MESSAGE, 0.0
            if kind != ONCE:
                command, interval_us = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 1e6 / RATES_HZ[kind]
            request = mavlink.MAVLink_command_long_message(
                SYSID, AUTOPILOT, command, 0, kind, interval_us, 0, 0, 0, 0, 0
            )
            self._socket.sendto(request.pack(self._mav), whom)
            self._mav.seq = (self._mav.seq + 1) % 256


def arrival_ns(extra: list[tuple[int, int, bytes]]) -> int:
    """Returns the kernel's receive time of the datagram (SO_TIMESTAMPNS) on the monotonic clock; else the current
    time.

    A thread of a busy process wakes up late, by up to metres of flight.
    """
    for level, kind, data in extra:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, rest_ns = TIMESPEC.unpack(data[: TIMESPEC.size])
            age_ns = time.time_ns() - (seconds * 1_000_000_000 + rest_ns)
            return time.monotonic_ns() - max(0, age_ns)
    return time.monotonic_ns()


def record(log: FlightLog, message: Any, now_ns: int) -> None:
    """Adds one decoded message, received at ``now_ns``, to ``log``."""
    kind = message.get_type()
    if kind == "SYSTEM_TIME":
        log.time.update(message.time_boot_ms, now_ns)
    elif kind == "SIM_STATE":
        t_ns = log.time.current_cycle_ns(now_ns)
        if t_ns is not None and (not log.truth or t_ns > log.truth[-1].t_ns):
            place = message.lat_int * 1e-7, message.lon_int * 1e-7, message.alt
            velocity = message.vn, message.ve, message.vd
            log.truth.append(Truth(t_ns, *place, velocity, message.roll, message.pitch, message.yaw))
    elif kind == "STATUSTEXT":
        log.texts.append(StatusTextRecord(now_ns, message.severity, message.text))
    elif kind == "GLOBAL_POSITION_INT":
        t_ns = log.time.monotonic_ns(message.time_boot_ms)
        if t_ns is not None:
            log.positions.append(PositionRecord(t_ns, message.lat * 1e-7, message.lon * 1e-7))
    elif kind == "GPS_RAW_INT":
        log.fix_types[0].append((now_ns, message.fix_type))
    elif kind == "GPS2_RAW":
        log.fix_types[1].append((now_ns, message.fix_type))
    elif kind == "SYS_STATUS":
        healthy = message.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_GPS
        log.gps_healthy.append((now_ns, bool(healthy)))
    elif kind == "EKF_STATUS_REPORT":
        log.ekf_flags.append((now_ns, message.flags))
    elif kind == "AUTOPILOT_VERSION":
        major, minor, patch, stage = message.flight_sw_version.to_bytes(4, "big")
        commit = bytes(message.flight_custom_version).rstrip(b"\0").decode("ascii", "replace")
        log.version = f"{major}.{minor}.{patch}{STAGES.get(stage, '')} ({commit})"
    elif kind == "HEARTBEAT" and message.get_srcComponent() == AUTOPILOT:
        log.armed.append((now_ns, bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)))


def interpolate(before: Truth, after: Truth, t_ns: int) -> Truth:
    """Interpolates linearly in time, angles along the shorter arc."""
    share = (t_ns - before.t_ns) / (after.t_ns - before.t_ns)

    def mix(a: float, b: float) -> float:
        return a + share * (b - a)

    def turn(a: float, b: float) -> float:
        return a + share * ((b - a + math.pi) % (2 * math.pi) - math.pi)

    velocity = [mix(a, b) for a, b in zip(before.velocity_ned_mps, after.velocity_ned_mps, strict=True)]
    return Truth(
        t_ns=t_ns,
        lat_deg=mix(before.lat_deg, after.lat_deg),
        lon_deg=mix(before.lon_deg, after.lon_deg),
        amsl_m=mix(before.amsl_m, after.amsl_m),
        velocity_ned_mps=(velocity[0], velocity[1], velocity[2]),
        roll_rad=turn(before.roll_rad, after.roll_rad),
        pitch_rad=turn(before.pitch_rad, after.pitch_rad),
        yaw_rad=turn(before.yaw_rad, after.yaw_rad),
    )
