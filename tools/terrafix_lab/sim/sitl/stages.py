"""The stages of a SITL flight from boot to landing, with Terrafix as a separate process."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

from pymavlink.dialects.v20 import ardupilotmega as mavlink
from rich.console import Console

from terrafix.core.errors import LinkError, OutputError
from terrafix.vision.sources.description import CameraTable, Description, MountTable, StartTable, TelemetryTable
from terrafix_lab.sim.flights.folder import AGL_SIGMA_M, ATTITUDE_SIGMA_DEG, CAMERA, YAW_SIGMA_DEG
from terrafix_lab.sim.sitl.camera import SimulatedCamera
from terrafix_lab.sim.sitl.firmware import Firmware
from terrafix_lab.sim.sitl.firmware_log import POSITION_SOURCE
from terrafix_lab.sim.sitl.ground_side import GroundSide
from terrafix_lab.sim.sitl.observer import Observer
from terrafix_lab.sim.sitl.report import FIX_3D, Interruption, Times
from terrafix_lab.sim.sitl.scene import SitlScene
from terrafix_tools import child_process
from terrafix_tools.camera.description import write_toml

GPS_ID = 1  # Terrafix is the second GPS
BOOT_S = 120.0  # time-out until the filter has a position
READY_S = 60.0  # time-out until the first GPS_INPUT
STREAMS_S = 10.0  # until the IMU arrives at the requested rate: the initialisation needs the IMU data of the take-off
ARM_S = 120.0  # time-out until the pre-arm checks pass
ARM_AGAIN_S = 3.0
TAKE_OVER_S = 240.0  # time-out from arming until Terrafix has a 3D fix at SAFE_M
SAFE_M = 80.0  # height above home for the GNSS loss: above the least height at which Terrafix can match
SETTLED_S = 10.0  # Terrafix must have had its fix for this long
LOSS_S = 10.0
POLL_S = 0.2
GNSS_OFF = (("SIM_GPS_DISABLE", 1), ("SIM_GPS1_ENABLE", 0))  # parameters of ArduPilot up to 4.6, and of later versions
NO_FIX = 1  # GPS_INPUT is received, without a fix
CALM_S = 25.0  # time without GNSS before an interruption, and between two
DOWN_S = 5.0  # downtime; the firmware notices after 4 s
BACK_S = 120.0  # time-out from the end of an interruption to a 3D fix that the EKF uses
GLITCH = ("SIM_GPS1_GLTCH_X", "SIM_GPS_GLITCH_X")  # latitude added to the receiver's, of 4.7 and later, and before
SPOOF_DEG = 0.001  # 111 m
SWITCH_S = 60.0  # time-out until the autopilot has been switched to GPS_INPUT, and back
SPOOFED_S = 5.0  # from the switch to the kill
STOP_S = 45.0  # time of systemd for an ordered stop (TimeoutStopSec)


class FlightAborted(Exception):
    """The flight cannot continue; a result, not a usage error."""


class Daemon:
    """`terrafix run` as on a vehicle, in its own process: started by ``start``, ended by ``kill``, by this context or
    with this process.
    """

    def __init__(
        self,
        out: Path,
        scene: SitlScene,
        source: str,
        link: str,
        *,
        start_configured: bool = True,
        gnss: str = "advise",
    ) -> None:
        """``start_configured``: the camera description contains the start. ``gnss``: link.gnss. Raises OutputError."""
        self._process: subprocess.Popen[bytes] | None = None
        self._log = out / "terrafix.log"
        self._environment = os.environ | {"STATE_DIRECTORY": str(out / "state")}
        camera, config = out / "camera.toml", out / "terrafix.toml"
        home = scene.home
        start = StartTable(lat_deg=home.lat_deg, lon_deg=home.lon_deg, ground_amsl_m=round(home.amsl_m, 1))
        write_toml(camera, _description(start if start_configured else None), "The camera of the simulated vehicle.")
        try:
            link_lines = f'[link]\ngps_id = {GPS_ID}\ngnss = "{gnss}"\n'
            config.write_text(f'[source]\ncamera = "{camera}"\n{link_lines}', encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
        self._command = [sys.executable, "-m", "terrafix_lab.sim.sitl.child_process", str(os.getpid())]
        self._command += ["run", "--config", str(config)]
        self._command += ["--source", source, "--map", str(scene.map_path)]
        self._command += ["--link", link, "--out", str(out / "record")]

    def start(self) -> None:
        with self._log.open("ab") as log:
            self._process = subprocess.Popen(
                self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, env=self._environment
            )

    def kill(self) -> None:
        """Kills all of its processes without notice."""
        if self._process is not None:
            child_process.kill_tree(self._process)
            self._process = None

    def check(self) -> None:
        """Raises FlightAborted when it has ended."""
        if self._process is not None and self._process.poll() is not None:
            raise FlightAborted(f"Terrafix ended with exit code {self._process.returncode}; see {self._log}")

    def __enter__(self) -> "Daemon":
        return self

    def __exit__(self, *_: object) -> None:
        if self._process is not None:
            self._process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(STOP_S)
            self.kill()


class Stages:
    """One method per stage, to be called in this order. Each raises FlightAborted when the stage does not complete."""

    def __init__(
        self,
        firmware: Firmware,
        station: GroundSide,
        observer: Observer,
        daemon: Daemon,
        camera: SimulatedCamera,
        scene: SitlScene,
        console: Console,
    ) -> None:
        self._firmware, self._station, self._observer, self._camera = firmware, station, observer, camera
        self._daemon, self._scene, self._console = daemon, scene, console
        self.times = Times()

    def prepare(self) -> None:
        """Waits for the autopilot's GNSS position, then starts Terrafix, as a pilot does before take-off."""
        self._wait("position by GNSS", BOOT_S, self._has_position)
        self._station.upload(self._scene.mission)
        self._daemon.start()
        self._wait("GPS_INPUT", READY_S, lambda: self._fix(GPS_ID) >= NO_FIX)
        self._pause(STREAMS_S)
        self._print("autopilot and Terrafix ready")

    def take_off(self) -> None:
        """Arms as soon as the checks allow it, and starts the mission."""
        deadline_s = time.monotonic() + ARM_S
        while True:
            try:
                self._station.arm()
                self._station.start_mission()  # after arming, since MAVSDK arms in a mode of its own choice
                break
            except LinkError as error:
                if time.monotonic() > deadline_s:
                    raise FlightAborted(f"{error}; last text: {self._last_text()}") from None
                self._pause(ARM_AGAIN_S)
        self.times = replace(self.times, armed_ns=time.monotonic_ns())
        self._print("armed; take-off on GNSS")

    def lose_gnss(self) -> None:
        """Disables the GNSS when the vehicle is high enough and Terrafix has had a 3D fix for a while."""
        self._wait_until_ready()
        self._set_first_known(*GNSS_OFF)
        self._wait("loss of the GNSS", LOSS_S, lambda: self._fix(0) < FIX_3D)
        # Time of the first report without a fix; on a busy machine several may have arrived before this check.
        without = takewhile(lambda report: report[1] < FIX_3D, reversed(self._observer.log.fix_types[0]))
        *_, (lost_ns, _fix) = without
        self.times = replace(self.times, lost_ns=lost_ns)
        self._print("GNSS lost; GPS_INPUT alone")

    def kill_terrafix(self) -> None:
        """Kills all of Terrafix and restarts it, as systemd would."""
        self._pause(CALM_S)
        self._interrupt("Terrafix killed", "restart", DOWN_S, self._daemon.kill, self._daemon.start)

    def cover_camera(self, duration_s: float) -> None:
        """The camera sends nothing for ``duration_s``."""
        self._pause(CALM_S)
        self._interrupt("camera off", "camera's return", duration_s, self._camera.pause, self._camera.resume)

    def spoof_and_kill(self) -> None:
        """Shifts the receiver until the autopilot has been switched to GPS_INPUT, then kills Terrafix, ends the shift
        and restarts it: the switch must be undone.
        """
        self._wait_until_ready()
        before = self._position_source()
        self._set_first_known(*((name, SPOOF_DEG) for name in GLITCH))
        self._print("receiver spoofed")
        self._wait("switch to GPS_INPUT", SWITCH_S, lambda: self._position_source() != before)
        self._print(f"switched: {self._position_source()}")
        self._pause(SPOOFED_S)
        self._daemon.kill()
        self._pause(DOWN_S)
        self._set_first_known(*((name, 0.0) for name in GLITCH))
        self._daemon.start()
        self._wait("restored position source", SWITCH_S, lambda: self._position_source() == before)
        self._print(f"restored: {self._position_source()}")

    def land(self, limit_s: float) -> None:
        """Waits for the rest of the mission; the vehicle disarms itself after landing."""
        self._wait("landing", limit_s, lambda: not self._observer.log.armed[-1][1])
        self.times = replace(self.times, landed_ns=time.monotonic_ns())
        self._print("landed")

    def _interrupt(
        self, began: str, end: str, duration_s: float, begin: Callable[[], None], undo: Callable[[], None]
    ) -> None:
        """Interrupts for ``duration_s``, then waits for a 3D fix that the EKF uses."""
        begin()
        began_ns = time.monotonic_ns()
        self._print(began)
        self._pause(duration_s)
        undo()
        gap, before = Interruption(began_ns, time.monotonic_ns()), self.times.interruptions
        fixes, flags = self._observer.log.fix_types[GPS_ID], self._observer.log.ekf_flags

        def found() -> Interruption:
            """``gap`` with what the observer has received until now."""
            fix_ns = next((t_ns for t_ns, fix in fixes if t_ns > gap.ended_ns and fix >= FIX_3D), None)
            if fix_ns is None:
                return gap
            used = (t_ns for t_ns, now in flags if t_ns >= fix_ns and now & mavlink.EKF_POS_HORIZ_ABS)
            return replace(gap, recovered_ns=fix_ns, used_ns=next(used, None))

        def is_used() -> bool:
            self.times = replace(self.times, interruptions=(*before, found()))
            return self.times.interruptions[-1].used_ns is not None

        self._wait(f"3D fix after the {end}", BACK_S, lambda: is_used() or found().recovered_ns is not None)
        self._wait(f"position of the EKF after the {end}", BACK_S, is_used)
        back_s, used_s = ((t_ns or 0) - gap.ended_ns for t_ns in (found().recovered_ns, found().used_ns))
        self._print(f"3D fix {back_s / 1e9:.2f} s after the {end}, used {used_s / 1e9:.2f} s after it")

    def _wait_until_ready(self) -> None:
        what = f"{SAFE_M:.0f} m above home and 3D fix of Terrafix"
        self._wait(what, TAKE_OVER_S, self._ready_for_gnss_loss)

    def _position_source(self) -> dict[str, int]:
        return {name: self._station.parameter(name) for name in POSITION_SOURCE}

    def _set_first_known(self, *choices: tuple[str, float]) -> None:
        """Sets the first of these parameters that the firmware has: their names changed with its versions."""
        for name, value in choices:
            with contextlib.suppress(LinkError):
                self._station.set_parameter(name, value)
                return

    def _has_position(self) -> bool:
        flags = self._observer.log.ekf_flags
        return bool(flags) and bool(flags[-1][1] & mavlink.EKF_POS_HORIZ_ABS)

    def _ready_for_gnss_loss(self) -> bool:
        fixes, truth = self._observer.log.fix_types[GPS_ID], self._observer.log.truth[-1]
        since_ns = time.monotonic_ns() - round(SETTLED_S * 1e9)
        recent = [fix for t_ns, fix in fixes[-200:] if t_ns >= since_ns]
        high = truth.amsl_m - self._scene.home.amsl_m >= SAFE_M
        return high and len(recent) >= SETTLED_S and min(recent) >= FIX_3D

    def _fix(self, gps: int) -> int:
        fixes = self._observer.log.fix_types[gps]
        return fixes[-1][1] if fixes else 0

    def _last_text(self) -> str:
        texts = self._observer.log.texts
        return texts[-1].text if texts else "none"

    def _wait(self, what: str, limit_s: float, until: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + limit_s
        while not until():
            if time.monotonic() > deadline_s:
                raise FlightAborted(f"no {what} within {limit_s:.0f} s; last text: {self._last_text()}")
            self._pause(POLL_S)

    def _pause(self, pause_s: float) -> None:
        time.sleep(pause_s)
        self._firmware.check()
        self._daemon.check()

    def _print(self, text: str) -> None:
        self._console.print(text, highlight=False)


def _description(start: StartTable | None) -> Description:
    """Returns the description that a pilot writes: the camera, and optionally the start."""
    return Description(
        name="ardupilot",
        camera=CameraTable.of(CAMERA),
        mount=MountTable.of(CAMERA),
        start=start,
        telemetry=TelemetryTable(
            yaw_sigma_deg=YAW_SIGMA_DEG, agl_sigma_m=AGL_SIGMA_M, attitude_sigma_deg=ATTITUDE_SIGMA_DEG
        ),
    )
