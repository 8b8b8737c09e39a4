"""Who takes notes of a flight on ArduPilot's firmware: the simulator's truth, what the autopilot says and believes.

It listens on a MAVLink port of its own and asks for streams there; it says nothing that could help the flight."""

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
LISTEN_S = 0.1  # between two looks whether to stop
TIMES_KEPT = 80  # of the firmware's clock: two seconds
TOGETHER_NS = 1_000_000  # what is said in one turn of its loop comes in a burst
ASK_AGAIN_S = 2.0  # requests are UDP datagrams and may come before the firmware listens
RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_SIM_STATE: 40,  # of a plane's 50 Hz loop no stream gets more than 80 %
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 40,  # the same rate: it comes right before the state, which has no time itself
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
    """Where the simulated vehicle is; ``t_ns`` is on the monotonic clock (SimulatedTime)."""

    t_ns: int
    lat_deg: float
    lon_deg: float
    amsl_m: float
    velocity_ned_mps: tuple[float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float


@dataclass(frozen=True)
class Said:
    """A STATUSTEXT."""

    t_ns: int
    severity: int
    text: str


@dataclass(frozen=True)
class Belief:
    """Where the autopilot believes to be."""

    t_ns: int
    lat_deg: float
    lon_deg: float


class SimulatedTime:
    """The firmware's clock, by which its world moves, on ours.

    It calculates ahead and then waits, and is late when the machine is busy: what it says comes up to some 20 ms aside
    of where its clock would have it, in which a plane flies half a metre. A picture of the state that had come by then
    would jump by as much, as no camera in the air does. What the last seconds have in common is how far the clocks are
    apart."""

    def __init__(self) -> None:
        self._apart_ns: deque[int] = deque(maxlen=TIMES_KEPT)
        self._boot_ms, self._arrival_ns = 0, 0  # of its clock, when it was said last

    def heard(self, boot_ms: int, arrival_ns: int) -> None:
        """A SYSTEM_TIME."""
        self._apart_ns.append(arrival_ns - boot_ms * 1_000_000)
        self._boot_ms, self._arrival_ns = boot_ms, arrival_ns

    def ours_ns(self, boot_ms: int) -> int | None:
        """On the monotonic clock; None before the first time."""
        return boot_ms * 1_000_000 + round(statistics.median(self._apart_ns)) if self._apart_ns else None

    def of_this_turn_ns(self, arrival_ns: int) -> int | None:
        """When it was, by its clock, for a message without a time. None: its clock was not said in the same turn."""
        return self.ours_ns(self._boot_ms) if arrival_ns - self._arrival_ns < TOGETHER_NS else None


@dataclass
class Notes:
    """Everything that was heard, in order of arrival. ``(t_ns, value)`` where there is no name; ``t_ns`` is that of the
    arrival where it is not that of the firmware's clock."""

    truth: list[Truth] = field(default_factory=list)
    said: list[Said] = field(default_factory=list)
    beliefs: list[Belief] = field(default_factory=list)
    fix_types: tuple[list[tuple[int, int]], list[tuple[int, int]]] = field(default_factory=lambda: ([], []))  # GPS 1, 2
    gps_healthy: list[tuple[int, bool]] = field(default_factory=list)  # SYS_STATUS: of the GPS in use
    ekf_flags: list[tuple[int, int]] = field(default_factory=list)
    version: str = ""  # of the firmware, with the start of its commit
    armed: list[tuple[int, bool]] = field(default_factory=list)  # from its heartbeats
    time: SimulatedTime = field(default_factory=SimulatedTime)


class Observer:
    """A context manager; ``notes`` fills until it ends. Safe to read from any thread: the lists only grow."""

    def __init__(self, port: int) -> None:
        """Raises LinkError: the port is taken."""
        self.notes = Notes()
        self._mav = mavlink.MAVLink(None, srcSystem=SYSID, srcComponent=COMPID)
        self._mav.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise LinkError(
                f"UDP port {port} cannot be listened on ({error.strerror}); choose another --port"
            ) from None
        self._socket.settimeout(LISTEN_S)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_TIMESTAMPNS, 1)
        self._seen: set[int] = set()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="sitl-observer", daemon=True)

    def truth_at(self, t_ns: int) -> Truth | None:
        """Between the two states around ``t_ns``; None before the first and after the last of them."""
        states = self.notes.truth
        after = bisect.bisect_left(states, t_ns, key=lambda state: state.t_ns)
        if after == len(states) or (after == 0 and states[0].t_ns != t_ns):
            return None
        return states[after] if after == 0 else between(states[after - 1], states[after], t_ns)

    def __enter__(self) -> "Observer":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _listen(self) -> None:
        asked_s = -ASK_AGAIN_S
        while not self._stopping.is_set():
            try:
                packet, extra, _, sender = self._socket.recvmsg(DATAGRAM_MAX, socket.CMSG_SPACE(TIMESPEC.size))
            except (TimeoutError, ConnectionRefusedError):
                continue
            now_ns = arrival_ns(extra)
            for message in self._mav.parse_buffer(packet) or []:
                take(self.notes, message, now_ns)
                self._seen.add(message.get_msgId())
            missing = {*RATES_HZ, ONCE} - self._seen
            if missing and time.monotonic() - asked_s > ASK_AGAIN_S:
                asked_s = time.monotonic()
                self._ask(missing, sender)

    def _ask(self, kinds: set[int], whom: tuple[str, int]) -> None:
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
    """When the kernel had the datagram, on the monotonic clock; else now.

    A thread of a busy process is woken late, and what it then calls now is up to metres of flight after the truth."""
    for level, kind, data in extra:
        if level == socket.SOL_SOCKET and kind == SO_TIMESTAMPNS:
            seconds, rest_ns = TIMESPEC.unpack(data[: TIMESPEC.size])
            age_ns = time.time_ns() - (seconds * 1_000_000_000 + rest_ns)
            return time.monotonic_ns() - max(0, age_ns)
    return time.monotonic_ns()


def take(notes: Notes, message: Any, now_ns: int) -> None:
    """One decoded message, that came at ``now_ns``, into ``notes``."""
    kind = message.get_type()
    if kind == "SYSTEM_TIME":
        notes.time.heard(message.time_boot_ms, now_ns)
    elif kind == "SIM_STATE":
        t_ns = notes.time.of_this_turn_ns(now_ns)
        if t_ns is not None and (not notes.truth or t_ns > notes.truth[-1].t_ns):
            place = message.lat_int * 1e-7, message.lon_int * 1e-7, message.alt
            velocity = message.vn, message.ve, message.vd
            notes.truth.append(Truth(t_ns, *place, velocity, message.roll, message.pitch, message.yaw))
    elif kind == "STATUSTEXT":
        notes.said.append(Said(now_ns, message.severity, message.text))
    elif kind == "GLOBAL_POSITION_INT":
        t_ns = notes.time.ours_ns(message.time_boot_ms)
        if t_ns is not None:
            notes.beliefs.append(Belief(t_ns, message.lat * 1e-7, message.lon * 1e-7))
    elif kind == "GPS_RAW_INT":
        notes.fix_types[0].append((now_ns, message.fix_type))
    elif kind == "GPS2_RAW":
        notes.fix_types[1].append((now_ns, message.fix_type))
    elif kind == "SYS_STATUS":
        healthy = message.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_GPS
        notes.gps_healthy.append((now_ns, bool(healthy)))
    elif kind == "EKF_STATUS_REPORT":
        notes.ekf_flags.append((now_ns, message.flags))
    elif kind == "AUTOPILOT_VERSION":
        major, minor, patch, stage = message.flight_sw_version.to_bytes(4, "big")
        commit = bytes(message.flight_custom_version).rstrip(b"\0").decode("ascii", "replace")
        notes.version = f"{major}.{minor}.{patch}{STAGES.get(stage, '')} ({commit})"
    elif kind == "HEARTBEAT" and message.get_srcComponent() == AUTOPILOT:
        notes.armed.append((now_ns, bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)))


def between(before: Truth, after: Truth, t_ns: int) -> Truth:
    """Linear in time, angles the short way round."""
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
