"""Rig of the PX4 tests: PX4's firmware with its own simulator (SIH), a ground station that flies it, and the real edge
and node of the link, fed with estimates made from the simulator's truth.

``Px4Flight.step`` runs all of it: it receives from the firmware on both links and sends what is due."""

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
from stationary_copter import stationary_estimate

from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.core.geodesy import quat_from_rot, rot_w_b
from terrafix.link.edge import open_edge
from terrafix.link.integrity.output_predictor import offset
from terrafix.link.node import LinkNode
from terrafix_tools.in_process import InProcessShell

BINARY_VARIABLE = "TERRAFIX_PX4_SITL"
HOME = (48.0, 11.0, 500.0)
WAIT_S = 90.0  # time-out; long, because the machine may be busy
METRES_PER_DEGREE = 111_195.0

HOVER_M = 20.0
WAYPOINT_M = 10.0  # acceptance radius of a waypoint (NAV_ACC_RAD)

AUTO = 4  # main mode (px4_custom_mode.h)
TAKEOFF, LOITER, MISSION, LAND = 2, 3, 4, 6  # sub-modes of AUTO

NO_RADIO = {"COM_RC_IN_MODE": 4, "COM_LOW_BAT_ACT": 0}
NO_GPS = {"SENS_EN_GPSSIM": 0, "EKF2_GPS_CTRL": 0, "SYS_HAS_GPS": 0}
OURS = {"EKF2_AGP0_ID": 1, "EKF2_AGP0_CTRL": 1}


@dataclass(frozen=True)
class Ports:
    """UDP ports: the firmware sends to ``companion``, and listens at ``ground``."""

    companion: int
    ground: int


def _is_free(port: int) -> bool:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind(("0.0.0.0", port))
        except OSError:
            return False
        return True


@contextmanager
def _instance() -> Iterator[int]:
    """-> a free instance number of PX4, from which its ports follow; locked against other tests until the end."""
    for number in range(10):
        with Path(tempfile.gettempdir(), f"terrafix-px4-{number}").open("w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            if all(_is_free(base + number) for base in (14540, 14580, 18570, 19450)):
                yield number
                return
    pytest.fail("ten instances of PX4 are running")


@contextmanager
def px4(folder: Path, parameters: dict[str, float], model: str = "sihsim_quadx") -> Iterator[Ports]:
    """Runs the firmware with the vehicle on the ground at HOME; skips the test if there is no binary."""
    named = os.environ.get(BINARY_VARIABLE, "")
    binary = Path(named).expanduser() if named else None
    if binary is None or not binary.is_file():
        pytest.skip(f"PX4 MISSING: set {BINARY_VARIABLE} to a PX4 binary, (see docs/sitl.md)")
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
    """Errors of the estimates; tests change them in flight."""

    north_m: float = 0.0
    east_m: float = 0.0
    sigma_m: float = 3.0  # 1-sigma per axis that the estimates report
    wander_m: float = 1.0  # 1-sigma of a first-order Gauss-Markov error
    wander_s: float = 15.0  # its correlation time
    noise_m: float = 0.5  # 1-sigma, white
    late_s: float = 0.3  # delay from the true state to the estimate
    silent: bool = False  # no estimates


class Px4Flight:
    """One flight, run by ``step``.

    ``newest``: the newest MAVLink message of each type; ``texts``: STATUSTEXT with its time; ``published``: messages of
    edge and node; ``modes``: (s, main mode, sub-mode) at each change; ``errors_m``: (s, error of the EKF, error of the
    sent position) in metres, for each GpsInput."""

    def __init__(self, ports: Ports, outputs: tuple[str, ...] = (), seed: int = 1) -> None:
        section = {"device": f"udpin:127.0.0.1:{ports.companion}", "outputs": list(outputs)}
        self.edge = open_edge(msgspec.convert(section, LinkSection))
        self.shell = InProcessShell({"link": LinkNode(10.0)}, self._take, edges={"link": self.edge})
        self._sent_to = ("127.0.0.1", ports.ground)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self.errors = Errors()
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.published: list[m.Message] = []
        self.modes: list[tuple[float, int, int]] = []
        self.errors_m: list[tuple[float, float, float]] = []
        self._truths: deque[tuple[int, Any]] = deque(maxlen=400)
        self._random = random.Random(seed)
        self._wander = [0.0, 0.0]
        self._due: dict[str, float] = {}
        self.began_s = time.monotonic()
        camera = m.Camera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
        sigmas = {"start_sigma_m": 5.0, "yaw_sigma_deg": 5.0, "agl_sigma_m": 5.0, "attitude_sigma_deg": 2.0}
        lat, lon, amsl = HOME
        self.shell.feed(m.Origin(t_ns=0, camera=camera, lat_deg=lat, lon_deg=lon, ground_amsl_m=amsl, **sigmas))

    @property
    def s(self) -> float:
        return time.monotonic() - self.began_s

    # --- commands ---

    def send_command(self, command: int, *params: float) -> None:
        self.send(mavlink.MAVLink_command_long_message(*self._target, command, 0, *params, *(0.0,) * (7 - len(params))))

    def set_mode(self, sub: int) -> None:
        self.send_command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, float(AUTO), float(sub))

    def send(self, message: Any) -> None:
        self._socket.sendto(message.pack(self._mav), self._sent_to)

    def set_parameter(self, name: str, value: float, *, whole: bool = True) -> None:
        """Sets a parameter. PX4 expects the bits of an integer parameter in the float field."""
        bits = struct.unpack("<f", struct.pack("<i", int(value)))[0] if whole else value
        kind = mavlink.MAV_PARAM_TYPE_INT32 if whole else mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_set_message(*self._target, name.encode(), bits, kind))

    @property
    def _target(self) -> tuple[int, int]:
        heartbeat = self.newest.get("HEARTBEAT")
        return (heartbeat.get_srcSystem() if heartbeat else 1), 1

    # --- state of the vehicle ---

    @property
    def armed(self) -> bool:
        return bool(self.newest["HEARTBEAT"].base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)

    def mode(self) -> tuple[int, int]:
        """-> main mode, sub-mode."""
        custom = self.newest["HEARTBEAT"].custom_mode
        return (custom >> 16) & 0xFF, (custom >> 24) & 0xFF

    def truth(self) -> tuple[float, float, float] | None:
        """-> latitude, longitude [deg], AMSL [m] of the simulated vehicle."""
        now = self.newest.get("HIL_STATE_QUATERNION")
        return (now.lat / 1e7, now.lon / 1e7, now.alt / 1e3) if now else None

    def error_m(self) -> float:
        """Horizontal error of the EKF's position."""
        reported, truth = self.newest.get("GLOBAL_POSITION_INT"), self.truth()
        if reported is None or truth is None:
            return math.nan
        return apart_m((reported.lat / 1e7, reported.lon / 1e7), truth)

    def height_m(self) -> float:
        truth = self.truth()
        return truth[2] - HOME[2] if truth else 0.0

    def distance_from_home_m(self) -> float:
        truth = self.truth()
        return apart_m(HOME, truth) if truth else 0.0

    def flags(self) -> int:
        status = self.newest.get("ESTIMATOR_STATUS")
        return int(status.flags) if status else 0

    def has_position(self) -> bool:
        return bool(self.flags() & mavlink.ESTIMATOR_POS_HORIZ_ABS)

    # --- the loop ---

    def wait_for(
        self,
        what: str,
        condition: Callable[[], bool],
        repeat: Callable[[], None] = lambda: None,
        wait_s: float = WAIT_S,
    ) -> float:
        """Steps until ``condition``; calls ``repeat`` once a second. -> seconds that it took. AssertionError after
        ``wait_s``."""
        began_s, again_s = time.monotonic(), 0.0
        while not condition():
            self.step()
            if time.monotonic() > again_s and "HEARTBEAT" in self.newest:
                again_s = time.monotonic() + 1.0
                repeat()
            assert time.monotonic() - began_s < wait_s, f"time-out: {what}; last texts: {self.texts[-8:]}"
        return time.monotonic() - began_s

    def run_for(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self.step()

    def step(self) -> None:
        now_ns = time.monotonic_ns()
        if self._is_due("heartbeat", 1.0):
            self.send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
        if self._is_due("request", 3.0) and "HEARTBEAT" in self.newest:
            for kind, hz in (("HIL_STATE_QUATERNION", 50.0), ("ESTIMATOR_STATUS", 5.0), ("GLOBAL_POSITION_INT", 20.0)):
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                self.send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 1e6 / hz)
        self._receive(now_ns)
        self.shell.poll(now_ns)
        if not self.errors.silent and self._truths and self._is_due("estimate", 0.4):
            estimate = self._estimate(now_ns)
            if estimate is not None:
                self.shell.feed(estimate)
        self.shell.tick(now_ns)
        time.sleep(0.002)

    def _take(self, _publisher: str, message: m.Message) -> None:
        self.published.append(message)
        truth = self.truth()
        if isinstance(message, m.GpsInput) and truth:
            sent = apart_m((message.lat_deg, message.lon_deg), truth) if message.fix_type >= 3 else math.nan
            self.errors_m.append((self.s, self.error_m(), sent))

    def _receive(self, now_ns: int) -> None:
        with contextlib.suppress(BlockingIOError):
            while True:
                for message in self._parser.parse_buffer(self._socket.recv(4096)) or []:
                    self._on_mavlink(message, now_ns)

    def _on_mavlink(self, message: Any, now_ns: int) -> None:
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
        elif kind == "HEARTBEAT" and (not self.modes or self.modes[-1][1:] != self.mode()):
            self.modes.append((self.s, *self.mode()))

    def _estimate(self, now_ns: int) -> m.NavEstimate | None:
        """-> the true state of ``late_s`` ago with the errors; None: that state is not known."""
        errors = self.errors
        estimate_ns = now_ns - round(errors.late_s * 1e9)
        older = [x for x in self._truths if x[0] <= estimate_ns]
        if not older:
            return None
        t_ns, truth = older[-1]
        decay = math.exp(-0.4 / errors.wander_s)
        drive = errors.wander_m * math.sqrt(1 - decay * decay)
        self._wander = [decay * w + self._random.gauss(0, drive) for w in self._wander]
        east_m = errors.east_m + self._wander[0] + self._random.gauss(0, errors.noise_m)
        north_m = errors.north_m + self._wander[1] + self._random.gauss(0, errors.noise_m)
        lat, lon = offset(truth.lat / 1e7, truth.lon / 1e7, east_m, north_m)
        cov = [0.0] * 36
        cov[0] = cov[7] = cov[14] = errors.sigma_m**2
        velocity = (truth.vy / 100, truth.vx / 100, -truth.vz / 100)
        return msgspec.structs.replace(
            stationary_estimate(t_ns, (lat, lon, truth.alt / 1e3)),
            velocity_enu_mps=velocity,
            q_w_b=_enu_from_ned_quaternion(truth.attitude_quaternion),
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

    # --- flight phases ---

    def take_off(self) -> None:
        """Arms with all arming checks of the firmware, climbs, and hovers in LOITER."""
        self.wait_for("position", self.has_position)
        self.run_for(5.0)
        self.set_parameter("MIS_TAKEOFF_ALT", HOVER_M, whole=False)
        self.wait_for("take-off mode", lambda: self.mode() == (AUTO, TAKEOFF), lambda: self.set_mode(TAKEOFF))
        arm = lambda: self.send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)  # noqa: E731
        self.wait_for("arming", lambda: self.armed, arm)
        self.wait_for("hover height", lambda: self.height_m() > 0.8 * HOVER_M)
        self.wait_for("hold", lambda: self.mode() == (AUTO, LOITER), lambda: self.set_mode(LOITER))
        self.run_for(10.0)

    def mission(self, places: list[tuple[float, float]]) -> list[float]:
        """Flies a mission. ``places``: (latitude, longitude) [deg]. -> true horizontal distance [m] from each waypoint
        when the firmware reported it as reached."""
        self.newest.pop("MISSION_ACK", None)
        self.send(mavlink.MAVLink_mission_count_message(*self._target, len(places)))
        self.wait_for("mission upload", lambda: self._upload_waypoint(places), wait_s=30.0)
        self.wait_for("mission mode", lambda: self.mode() == (AUTO, MISSION), lambda: self.set_mode(MISSION))
        distances_m: dict[int, float] = {}

        def done() -> bool:
            reached = self.newest.get("MISSION_ITEM_REACHED")
            if reached is not None and reached.seq not in distances_m:
                distances_m[reached.seq] = apart_m(places[reached.seq], self.truth() or HOME)
            return len(distances_m) == len(places)

        self.wait_for("end of the mission", done, wait_s=300.0)
        return list(distances_m.values())

    def _upload_waypoint(self, places: list[tuple[float, float]]) -> bool:
        request = self.newest.pop("MISSION_REQUEST_INT", None) or self.newest.pop("MISSION_REQUEST", None)
        if request is not None:
            frame, command = mavlink.MAV_FRAME_GLOBAL_RELATIVE_ALT_INT, mavlink.MAV_CMD_NAV_WAYPOINT
            lat, lon = (round(x * 1e7) for x in places[request.seq])
            numbers = (0.0, 2.0, 0.0, math.nan, lat, lon, HOVER_M)
            current = int(request.seq == 0)
            self.send(
                mavlink.MAVLink_mission_item_int_message(
                    *self._target, request.seq, frame, command, current, 1, *numbers
                )
            )
        return "MISSION_ACK" in self.newest

    def land(self) -> None:
        send_land = lambda: None if self.mode() == (AUTO, LAND) else self.set_mode(LAND)  # noqa: E731
        self.wait_for("touchdown", lambda: not self.armed, send_land)

    def largest_error_m(self, since_s: float) -> float:
        """-> largest horizontal error of the EKF since ``since_s``, of the values in ``errors_m``."""
        return max(error_m for s, error_m, _ in self.errors_m if s >= since_s)


def _enu_from_ned_quaternion(q: Sequence[float]) -> tuple[float, float, float, float]:
    """-> q_w_b (FRD body in ENU, as in NavEstimate) from PX4's quaternion w, x, y, z (FRD body in NED)."""
    w, x, y, z = q
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return quat_from_rot(rot_w_b(yaw, pitch, roll))


def apart_m(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    """-> horizontal distance of two positions (latitude, longitude [deg], ...)."""
    north = (one[0] - other[0]) * METRES_PER_DEGREE
    return math.hypot(north, (one[1] - other[1]) * METRES_PER_DEGREE * math.cos(math.radians(one[0])))
