"""PX4's own firmware with the simulator that it brings (SIH), a pilot of it, and the Terrafix that says where it is.

All in one loop: `Flight.step` listens to the firmware on both links, and the real edge and node are given estimates
made of the simulator's truth."""

import contextlib
import fcntl
import math
import os
import random
import socket
import struct
import subprocess
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import standing

from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.link.edge import open_edge
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode

BINARY_VARIABLE = "TERRAFIX_PX4_SITL"
HOME = (48.0, 11.0, 500.0)
WAIT_S = 90.0  # generous: the machine may be busy
METRES_PER_DEGREE = 111_195.0

HOVER_M = 20.0
WAYPOINT_M = 10.0  # so near it calls a waypoint reached (NAV_ACC_RAD)

AUTO = 4  # main mode, px4_custom_mode.h; its sub-modes:
TAKEOFF, LOITER, MISSION, LAND = 2, 3, 4, 6

NO_RADIO = {"COM_RC_IN_MODE": 4, "COM_LOW_BAT_ACT": 0}
NO_GPS = {"SENS_EN_GPSSIM": 0, "EKF2_GPS_CTRL": 0, "SYS_HAS_GPS": 0}
OURS = {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1}


@dataclass(frozen=True)
class Ports:
    """UDP: the firmware speaks to the one, and listens at the other."""

    companion: int
    ground: int


def _free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))
        except OSError:
            return False
        return True


@contextmanager
def _instance() -> Iterator[int]:
    """The ports follow from its number: one that nobody else has, and that no other test takes meanwhile."""
    for number in range(10):
        with Path(tempfile.gettempdir(), f"terrafix-px4-{number}").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if all(_free(base + number) for base in (14540, 14580, 18570, 19450)):
                yield number
                return
    pytest.fail("ten PX4 run already")


@contextmanager
def px4(folder: Path, parameters: dict[str, float], model: str = "sihsim_quadx") -> Iterator[Ports]:
    """The firmware on the ground at HOME."""
    named = os.environ.get(BINARY_VARIABLE, "")
    binary = Path(named).expanduser() if named else None
    if binary is None or not binary.is_file():
        pytest.skip(f"PX4 MISSING: set {BINARY_VARIABLE} to a PX4 binary, docs/sitl.md says which")
    environment = os.environ | {"PX4_SIM_MODEL": model}
    environment |= {f"PX4_HOME_{name}": str(value) for name, value in zip(("LAT", "LON", "ALT"), HOME, strict=True)}
    environment |= {f"PX4_PARAM_{name}": str(value) for name, value in (NO_RADIO | parameters).items()}
    with _instance() as number, (folder / "console").open("wb") as console:
        command = [str(binary), "-d", "-i", str(number), "-w", str(folder), str(binary.parent.parent / "etc")]
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=console, stderr=console
        )
        try:
            yield Ports(14540 + number, 18570 + number)
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(10)


@dataclass
class Errors:
    """Of the estimates: what a flight does to them is set from outside."""

    north_m: float = 0.0
    east_m: float = 0.0
    sigma_m: float = 3.0  # what they claim
    wander_m: float = 1.0  # 1-sigma of what comes and goes
    wander_s: float = 15.0
    noise_m: float = 0.5
    late_s: float = 0.3
    silent: bool = False


class Flight:
    """``step`` it; what was heard stays."""

    def __init__(self, ports: Ports, outputs: tuple[str, ...] = (), seed: int = 1) -> None:
        section = {"device": f"udpin:127.0.0.1:{ports.companion}", "outputs": list(outputs)}
        self.edge, self.node = open_edge(msgspec.convert(section, LinkSection)), LinkNode(10.0)
        self._sent_to = ("127.0.0.1", ports.ground)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._ear = mavlink.MAVLink(None)
        self._ear.robust_parsing = True
        self.errors = Errors()
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.said: list[m.Message] = []
        self.modes: list[tuple[float, int, int]] = []
        self.off: list[tuple[float, float, float]] = []  # (s, filter against truth, sent against truth)
        self._truths: deque[tuple[int, Any]] = deque(maxlen=400)
        self._random = random.Random(seed)
        self._wander = [0.0, 0.0]
        self._due: dict[str, float] = {}
        self.began_s = time.monotonic()
        camera = m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
        sigmas = {"start_sigma_m": 5.0, "yaw_sigma_deg": 5.0, "agl_sigma_m": 5.0, "attitude_sigma_deg": 2.0}
        lat, lon, amsl = HOME
        self.edge.heard(m.Origin(t_ns=0, camera=camera, lat_deg=lat, lon_deg=lon, ground_amsl_m=amsl, **sigmas))

    @property
    def s(self) -> float:
        return time.monotonic() - self.began_s

    # --- orders ---

    def order(self, command: int, *params: float) -> None:
        self.send(mavlink.MAVLink_command_long_message(*self._target, command, 0, *params, *(0.0,) * (7 - len(params))))

    def mode(self, sub: int) -> None:
        self.order(mavlink.MAV_CMD_DO_SET_MODE, 1.0, float(AUTO), float(sub))

    def send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._sent_to)

    def set(self, name: str, value: float, *, whole: bool = True) -> None:
        """PX4 wants the bits of an integer in the float."""
        bits = struct.unpack("<f", struct.pack("<i", int(value)))[0] if whole else value
        kind = mavlink.MAV_PARAM_TYPE_INT32 if whole else mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_set_message(*self._target, name.encode(), bits, kind))

    @property
    def _target(self) -> tuple[int, int]:
        beat = self.newest.get("HEARTBEAT")
        return (beat.get_srcSystem() if beat else 1), 1

    # --- what is known ---

    @property
    def armed(self) -> bool:
        return bool(self.newest["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def in_mode(self) -> tuple[int, int]:
        custom = self.newest["HEARTBEAT"].custom_mode
        return (custom >> 16) & 0xFF, (custom >> 24) & 0xFF

    def truth(self) -> tuple[float, float, float] | None:
        now = self.newest.get("HIL_STATE_QUATERNION")
        return (now.lat / 1e7, now.lon / 1e7, now.alt / 1e3) if now else None

    def off_truth_m(self) -> float:
        believed, truth = self.newest.get("GLOBAL_POSITION_INT"), self.truth()
        if believed is None or truth is None:
            return math.nan
        return apart_m((believed.lat / 1e7, believed.lon / 1e7), truth)

    def height_m(self) -> float:
        truth = self.truth()
        return truth[2] - HOME[2] if truth else 0.0

    def from_home_m(self) -> float:
        truth = self.truth()
        return apart_m(HOME, truth) if truth else 0.0

    def flags(self) -> int:
        status = self.newest.get("ESTIMATOR_STATUS")
        return int(status.flags) if status else 0

    def placed(self) -> bool:
        return bool(self.flags() & mavlink.ESTIMATOR_POS_HORIZ_ABS)

    # --- the loop ---

    def until(
        self, what: str, holds: Callable[[], bool], then: Callable[[], None] = lambda: None, wait_s: float = WAIT_S
    ) -> float:
        """-> how long it took. ``then`` is done once a second meanwhile."""
        began_s, again_s = time.monotonic(), 0.0
        while not holds():
            self.step()
            if time.monotonic() > again_s and "HEARTBEAT" in self.newest:
                again_s = time.monotonic() + 1.0
                then()
            assert time.monotonic() - began_s < wait_s, f"{what} did not come: {self.texts[-8:]}"
        return time.monotonic() - began_s

    def listen(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self.step()

    def step(self) -> None:
        now_ns = time.monotonic_ns()
        if self._is_due("beat", 1.0):
            self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
        if self._is_due("ask", 3.0) and "HEARTBEAT" in self.newest:
            for kind, hz in (("HIL_STATE_QUATERNION", 50.0), ("ESTIMATOR_STATUS", 5.0), ("GLOBAL_POSITION_INT", 20.0)):
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                self.order(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / hz)
        self._listen(now_ns)
        for message in self.edge.poll(now_ns):
            self.said.append(message)
            self._tell(self.node.on(message))
        if not self.errors.silent and self._truths and self._is_due("estimate", 0.4):
            estimate = self._estimate(now_ns)
            if estimate is not None:
                self._tell(self.node.on(estimate))
        if self._is_due("tick", 0.02):
            self._tell(self.node.tick(now_ns))
        time.sleep(0.002)

    def _tell(self, messages: Any) -> None:
        for message in messages:
            self.said.append(message)
            self.edge.heard(message)
            truth = self.truth()
            if isinstance(message, m.GpsInput) and truth:
                sent = apart_m((message.lat_deg, message.lon_deg), truth) if message.fix_type >= 3 else math.nan
                self.off.append((self.s, self.off_truth_m(), sent))

    def _listen(self, now_ns: int) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                for message in self._ear.parse_buffer(self._socket.recv(4096)) or []:
                    self._heard(message, now_ns)

    def _heard(self, message: Any, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.get_srcComponent() != 1:
            return
        if kind == "BAD_DATA":
            return
        self.newest[kind] = message
        if kind == "HIL_STATE_QUATERNION":
            self._truths.append((now_ns, message))
        elif kind == "STATUSTEXT":
            self.texts.append(f"{self.s:.1f} {message.text}")
        elif kind == "HEARTBEAT" and (not self.modes or self.modes[-1][1:] != self.in_mode()):
            self.modes.append((self.s, *self.in_mode()))

    def _estimate(self, now_ns: int) -> m.NavEstimate | None:
        errors = self.errors
        taken_ns = now_ns - round(errors.late_s * 1e9)
        older = [x for x in self._truths if x[0] <= taken_ns]
        if not older:
            return None
        t_ns, truth = older[-1]
        keep = math.exp(-0.4 / errors.wander_s)
        drive = errors.wander_m * math.sqrt(1 - keep * keep)
        self._wander = [keep * w + self._random.gauss(0, drive) for w in self._wander]
        east_m = errors.east_m + self._wander[0] + self._random.gauss(0, errors.noise_m)
        north_m = errors.north_m + self._wander[1] + self._random.gauss(0, errors.noise_m)
        lat, lon = offset(truth.lat / 1e7, truth.lon / 1e7, east_m, north_m)
        cov = [0.0] * 36
        cov[0] = cov[7] = cov[14] = errors.sigma_m**2
        velocity = (truth.vy / 100, truth.vx / 100, -truth.vz / 100)
        return msgspec.structs.replace(
            standing(t_ns, (lat, lon, truth.alt / 1e3)),
            velocity_enu_mps=velocity,
            q_w_b=_turned(truth.attitude_quaternion),
            cov=tuple(cov),
            agl_m=truth.alt / 1e3 - HOME[2],
            emitted_at_ns=now_ns,
        )

    def _is_due(self, what: str, period_s: float) -> bool:
        now_s = time.monotonic()
        if now_s < self._due.get(what, 0.0):
            return False
        self._due[what] = now_s + period_s
        return True

    def close(self) -> None:
        self.edge.close()
        self._socket.close()

    # --- what a pilot does ---

    def up(self) -> None:
        """Armed by the firmware's own checks, and hovering."""
        self.until("a position", self.placed)
        self.listen(5.0)
        self.set("MIS_TAKEOFF_ALT", HOVER_M, whole=False)
        self.until("take-off mode", lambda: self.in_mode() == (AUTO, TAKEOFF), lambda: self.mode(TAKEOFF))
        arm = lambda: self.order(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)  # noqa: E731
        self.until("arming", lambda: self.armed, arm)
        self.until("the height", lambda: self.height_m() > 0.8 * HOVER_M)
        self.until("hold", lambda: self.in_mode() == (AUTO, LOITER), lambda: self.mode(LOITER))
        self.listen(10.0)

    def mission(self, places: list[tuple[float, float]]) -> list[float]:
        """``places``: (latitude, longitude). -> how far from each it truly was when it called it reached."""
        self.newest.pop("MISSION_ACK", None)
        self.send(mavlink.MAVLink_mission_count_message(*self._target, len(places)))
        self.until("the upload", lambda: self._answers_for(places), wait_s=30.0)
        self.until("mission mode", lambda: self.in_mode() == (AUTO, MISSION), lambda: self.mode(MISSION))
        off: dict[int, float] = {}

        def done() -> bool:
            reached = self.newest.get("MISSION_ITEM_REACHED")
            if reached is not None and reached.seq not in off:
                off[reached.seq] = apart_m(places[reached.seq], self.truth() or HOME)
            return len(off) == len(places)

        self.until("the mission's end", done, wait_s=300.0)
        return list(off.values())

    def _answers_for(self, places: list[tuple[float, float]]) -> bool:
        asked = self.newest.pop("MISSION_REQUEST_INT", None) or self.newest.pop("MISSION_REQUEST", None)
        if asked is not None:
            frame, command = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mavlink.MAV_CMD_NAV_WAYPOINT
            lat, lon = (round(x * 1e7) for x in places[asked.seq])
            numbers = (0.0, 2.0, 0.0, math.nan, lat, lon, HOVER_M)
            current = int(asked.seq == 0)
            self.send(
                mavlink.MAVLink_mission_item_int_message(*self._target, asked.seq, frame, command, current, 1, *numbers)
            )
        return "MISSION_ACK" in self.newest

    def land(self) -> None:
        ordered = lambda: None if self.in_mode() == (AUTO, LAND) else self.mode(LAND)  # noqa: E731
        self.until("touchdown", lambda: not self.armed, ordered)

    def most_off_m(self, since_s: float) -> float:
        """Filter against truth, 10 times a second."""
        return max(off for s, off, _ in self.off if s >= since_s)


def _turned(q: Sequence[float]) -> tuple[float, float, float, float]:
    """PX4's (body to north, east, down) as an estimate has it."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return quat_from_rot(rot_w_b(yaw, pitch, roll))


def apart_m(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    north = (one[0] - other[0]) * METRES_PER_DEGREE
    return math.hypot(north, (one[1] - other[1]) * METRES_PER_DEGREE * math.cos(math.radians(one[0])))
