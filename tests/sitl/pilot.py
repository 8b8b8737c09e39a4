"""Rig of the SITL tests in flight: a ground station that flies ArduPilot's copter, and the Terrafix program beside it
(stationary_link.py)."""

import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from stationary_copter import HOME, WAIT_S

GUIDED = 4  # ArduCopter, mode.h
HOVER_M = 15.0


class Pilot:
    """A ground station on the firmware's SERIAL0. It flies the copter and records telemetry with this machine's clock.

    ``newest``: the newest message of each type; ``texts``: all STATUSTEXT; ``fixes``: (monotonic time [s], fix type) of
    every GPS_RAW_INT; ``gps_healthy``: the GPS flag of every SYS_STATUS."""

    def __init__(self, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", port))
        self._socket.settimeout(0.02)
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._parser = mavlink.MAVLink(None)
        self._parser.robust_parsing = True
        self._firmware_address: Any = None
        self._heartbeat_s = 0.0
        self.newest: dict[str, Any] = {}
        self.texts: list[str] = []
        self.fixes: list[tuple[float, int]] = []
        self.gps_healthy: list[bool] = []

    def wait_for(self, what: str, condition: Callable[[], bool], repeat: Callable[[], None] = lambda: None) -> None:
        """Receives until ``condition``; calls ``repeat`` at the start and then once a second. AssertionError after
        WAIT_S."""
        began_s = again_s = time.monotonic()
        while not condition():
            self._poll()
            if time.monotonic() > again_s:
                again_s = time.monotonic() + 1.0
                repeat()
            assert time.monotonic() - began_s < WAIT_S, f"time-out: {what}; last texts: {self.texts[-5:]}"

    def receive_for(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            self._poll()

    def send_command(self, command: int, *params: float) -> None:
        self._send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *params, *(0.0,) * (7 - len(params))))

    def fix_type(self) -> int:
        return self.fixes[-1][1] if self.fixes else 0

    def height_m(self) -> float:
        """Above home, as the firmware reports it."""
        position = self.newest.get("GLOBAL_POSITION_INT")
        return position.relative_alt / 1e3 if position else 0.0

    def true_distance_from_home_m(self) -> float:
        """Horizontal, of the simulated vehicle (SIM_STATE)."""
        truth = self.newest["SIM_STATE"]
        north_m = (truth.lat_int / 1e7 - HOME[0]) * 111_195.0
        return math.hypot(north_m, (truth.lon_int / 1e7 - HOME[1]) * 111_195.0 * math.cos(math.radians(HOME[0])))

    def close(self) -> None:
        self._socket.close()

    def _send(self, message: Any) -> None:
        if self._firmware_address:
            self._socket.sendto(message.pack(self._mav), self._firmware_address)

    def _poll(self) -> None:
        """Sends heartbeat and message requests once a second; receives one datagram, for 20 ms at most."""
        if self._firmware_address and time.monotonic() - self._heartbeat_s > 1.0:
            self._heartbeat_s = time.monotonic()
            self._send(mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3))
            for kind in ("GPS_RAW_INT", "SYS_STATUS", "GLOBAL_POSITION_INT", "SIM_STATE", "EKF_STATUS_REPORT"):
                number = getattr(mavlink, f"MAVLINK_MSG_ID_{kind}")
                self.send_command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, float(number), 100_000.0)
        try:
            data, self._firmware_address = self._socket.recvfrom(4096)
        except TimeoutError:
            return
        for message in self._parser.parse_buffer(data) or []:
            kind = message.get_type()
            self.newest[kind] = message
            if kind == "STATUSTEXT":
                self.texts.append(message.text)
            elif kind == "GPS_RAW_INT":
                self.fixes.append((time.monotonic(), message.fix_type))
            elif kind == "SYS_STATUS":
                gps = mavlink.MAV_SYS_STATUS_SENSOR_GPS
                self.gps_healthy.append(bool(message.onboard_control_sensors_health & gps))


def start_terrafix(port: int) -> subprocess.Popen[str]:
    command = [sys.executable, str(Path(__file__).parent / "stationary_link.py"), str(port)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)


def kill_terrafix(running: subprocess.Popen[str]) -> None:
    """Also closes the pipe: an open one raises a ResourceWarning, which fails whichever test then runs."""
    with running:
        running.kill()


def take_off(pilot: Pilot) -> None:
    """Arms in GUIDED mode with all arming checks of the firmware, and climbs to HOVER_M."""
    pilot.wait_for("3D fix", lambda: pilot.fix_type() == 3)
    flag = mavlink.EKF_POS_HORIZ_ABS
    pilot.wait_for("EKF position", lambda: bool(getattr(pilot.newest.get("EKF_STATUS_REPORT"), "flags", 0) & flag))
    mode = (float(mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED), float(GUIDED))
    pilot.wait_for(
        "GUIDED",
        lambda: pilot.newest["HEARTBEAT"].custom_mode == GUIDED,
        lambda: pilot.send_command(mavlink.MAV_CMD_DO_SET_MODE, *mode),
    )
    armed = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    pilot.wait_for(
        "arming",
        lambda: bool(pilot.newest["HEARTBEAT"].base_mode & armed),
        lambda: pilot.send_command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0),
    )
    params = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, HOVER_M)
    pilot.wait_for(
        "hover height",
        lambda: pilot.height_m() > HOVER_M - 1.0,
        lambda: pilot.send_command(mavlink.MAV_CMD_NAV_TAKEOFF, *params) if pilot.height_m() < 2.0 else None,
    )
