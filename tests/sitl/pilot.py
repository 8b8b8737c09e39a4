"""A pilot of ArduPilot's firmware, and the Terrafix that says where its copter stands."""

import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from standing_copter import HOME, WAIT_S

GUIDED = 4  # ArduCopter, mode.h
HOVER_M = 15.0


class Pilot:
    """A ground station on the firmware's SERIAL0 that flies the copter up and takes notes, on this machine's clock."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.02)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._ear = mavlink.MAVLink(None)
        self._ear.robust_parsing = True
        self._firmware: Any = None
        self._beat_s = 0.0
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.fixes: list[tuple[float, int]] = []  # (s, fix type) of every GPS_RAW_INT
        self.healthy: list[bool] = []  # the GPS, in every SYS_STATUS

    def until(self, what: str, holds: Callable[[], bool], then: Callable[[], None] = lambda: None) -> None:
        """Listens until it holds; ``then`` is done once a second meanwhile."""
        began_s = again_s = time.monotonic()
        while not holds():
            self._look()
            if time.monotonic() > again_s:
                again_s = time.monotonic() + 1.0
                then()
            assert time.monotonic() - began_s < WAIT_S, f"{what} did not come: {self.texts[-5:]}"

    def listen(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self._look()

    def order(self, command: int, *params: float) -> None:
        self._send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *params, *(0.0,) * (7 - len(params))))

    def fix(self) -> int:
        return self.fixes[-1][1] if self.fixes else 0

    def height_m(self) -> float:
        position = self.newest.get("GLOBAL_POSITION_INT")
        return position.relative_alt / 1e3 if position else 0.0

    def off_home_m(self) -> float:
        """Where it truly is, in the simulator."""
        truth = self.newest["SIM_STATE"]
        north_m = (truth.lat_int / 1e7 - HOME[0]) * 111_195.0
        return math.hypot(north_m, (truth.lon_int / 1e7 - HOME[1]) * 111_195.0 * math.cos(math.radians(HOME[0])))

    def close(self) -> None:
        self._socket.close()

    def _send(self, message: Any) -> None:
        if self._firmware:
            self._socket.sendto(message.pack(self._mav), self._firmware)

    def _look(self) -> None:
        if self._firmware and time.monotonic() - self._beat_s > 1.0:
            self._beat_s = time.monotonic()
            self._send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
            for kind in ("GPS_RAW_INT", "SYS_STATUS", "GLOBAL_POSITION_INT", "SIM_STATE", "EKF_STATUS_REPORT"):
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                self.order(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 100_000.0)
        try:
            data, self._firmware = self._socket.recvfrom(4096)
        except TimeoutError:
            return
        for message in self._ear.parse_buffer(data) or []:
            kind = message.get_type()
            self.newest[kind] = message
            if kind == "STATUSTEXT":
                self.texts.append(message.text)
            elif kind == "GPS_RAW_INT":
                self.fixes.append((time.monotonic(), message.fix_type))
            elif kind == "SYS_STATUS":
                self.healthy.append(bool(message.onboard_control_sensors_health & mavlink.MAV_SYS_STATUS_SENSOR_GPS))


def terrafix(port: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(Path(__file__).parent / "standing_link.py"), str(port)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def end(running: subprocess.Popen[str]) -> None:
    """Its pipe is closed as well: one that is left open fails the test in which the collector meets it."""
    with running:
        running.kill()


def fly_up(pilot: Pilot) -> None:
    """Armed as a pilot arms: by the firmware's own checks."""
    pilot.until("a 3D fix", lambda: pilot.fix() == 3)
    flag = mavlink.EKF_POS_HORIZ_ABS
    pilot.until("a position", lambda: bool(getattr(pilot.newest.get("EKF_STATUS_REPORT"), "flags", 0) & flag))
    mode = (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(GUIDED))
    guided = lambda: pilot.newest["HEARTBEAT"].custom_mode == GUIDED  # noqa: E731
    pilot.until("GUIDED", guided, lambda: pilot.order(mavlink.MAV_CMD_DO_SET_MODE, *mode))
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    pilot.until(
        "arming",
        lambda: bool(pilot.newest["HEARTBEAT"].base_mode & armed),
        lambda: pilot.order(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),
    )
    take_off = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, HOVER_M)
    pilot.until(
        "the height",
        lambda: pilot.height_m() > HOVER_M - 1.0,
        lambda: pilot.order(mavlink.MAV_CMD_NAV_TAKEOFF, *take_off) if pilot.height_m() < 2.0 else None,
    )
