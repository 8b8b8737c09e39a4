"""The unit in a booted systemd: a root folder in a container of systemd-nspawn.

It has the loopback of this computer, where a simulated camera and autopilot fly the shuttle of the soak."""

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Camera, NavEstimate
from terrafix.processes import PROCESSES
from terrafix_lab.chaos.camera import StreamedCamera, camera_toml
from terrafix_lab.chaos.scene import ChaosScene
from terrafix_lab.chaos.verdict import back_s
from terrafix_lab.faults.pictures import halved
from terrafix_lab.sim.autopilot.course import PeerState
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_tools.score import longest_gap_s

INSTALL_S, WAIT_S = 1800.0, 300.0  # limits; the machine may be busy
STEADY_S = 1.0  # with a fix before each fault
NAMES = {process.name for process in PROCESSES}


def do(*command: str | Path, limit_s: float = INSTALL_S) -> str:
    return subprocess.run([*map(str, command)], check=True, capture_output=True, text=True, timeout=limit_s).stdout


class Surroundings:
    """Camera and autopilot of the shuttle on the loopback of this computer. A context manager."""

    def __init__(self, scene: ChaosScene) -> None:
        ground = scene.course(0.0)
        self.scene, self.stream = scene, FrameStream()
        self.peer = AutopilotPeer(kind=Kind.COPTER, home_amsl_m=ground.amsl_m - ground.agl_m)
        self._began_s = time.monotonic()
        self._camera = StreamedCamera(self.stream, scene.jpeg, self._flight_s, scene.frame_hz)

    def __enter__(self) -> "Surroundings":
        self.port = self.peer.start(0, self.scene.course, self._flight_s)
        self._camera.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._camera.__exit__()
        self.stream.close()
        with suppress(RuntimeError):
            self.peer.stop()

    def _flight_s(self) -> float:
        return time.monotonic() - self._began_s

    def settings(self) -> str:
        start = self.scene.course(self._flight_s())
        return (
            f'[source]\npath = "{self.stream.url}"\ncamera = "/etc/terrafix/camera.toml"\n'
            f'start = "{start.lat_deg:.6f},{start.lon_deg:.6f}"\n[map]\npath = "/var/lib/terrafix/maps/place.gpkg"\n'
            f'[link]\ndevice = "udpout:127.0.0.1:{self.port}"\n'
        )

    def prepare(self, root: Path) -> None:
        """Map, camera and the enabled unit in the root folder of a vehicle on which Terrafix is installed."""
        maps = root / "var" / "lib" / "terrafix" / "maps"
        maps.mkdir(parents=True, exist_ok=True)
        shutil.copy(self.scene.map_path, maps / "place.gpkg")
        (root / "etc" / "terrafix" / "camera.toml").write_text(camera_toml(self.scene.camera))
        wanted = root / "etc/systemd/system/multi-user.target.wants" / "terrafix.service"
        wanted.parent.mkdir(parents=True, exist_ok=True)
        if not wanted.is_symlink():
            wanted.symlink_to("/etc/systemd/system/terrafix.service")

    def error_m(self, estimate: NavEstimate) -> float:
        """Horizontal distance of an estimate from the true position at its time."""
        true = self.scene.course(estimate.t_ns / 1e9 - self._began_s)
        return float(np.hypot(*LocalFrame(true.lat_deg, true.lon_deg).to_local(estimate.lat_deg, estimate.lon_deg)))

    def has_fix(self, from_s: float) -> bool:
        """Whether there is a 3D fix, since at least STEADY_S and after ``from_s`` (monotonic)."""
        now_s = time.monotonic()
        back = back_s([fix.received_s for fix in self.peer.fixes()[-1000:]], from_s, now_s)
        return back is not None and now_s - (from_s + back) > STEADY_S

    def silence_s(self, from_s: float) -> float:
        """Longest time without GPS_INPUT from ``from_s`` to now."""
        return longest_gap_s(self.peer.received_s, from_s, time.monotonic())


def shrunk(jpeg: bytes) -> bytes:
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return cv2.imencode(".jpg", halved(image))[1].tobytes()


def slower(scene: ChaosScene, times: float, folder: Path) -> ChaosScene:
    """The same flight, ``times`` as slow, and as many images, of half the width and height, which are written into
    ``folder``: for a computer that needs longer for each."""
    folder.mkdir(exist_ok=True)
    for jpeg in scene.jpegs:
        (folder / jpeg.name).write_bytes(shrunk(jpeg.read_bytes()))

    def course(t_s: float) -> PeerState:
        state = scene.course(t_s / times)
        return replace(state, vn_mps=state.vn_mps / times, ve_mps=state.ve_mps / times, vd_mps=state.vd_mps / times)

    return replace(
        scene,
        jpegs=[folder / jpeg.name for jpeg in scene.jpegs],
        camera=half(scene.camera),
        course=course,
        frame_hz=scene.frame_hz / times,
    )


def half(camera: Camera) -> Camera:
    """The camera of images of half the width and height; a pixel's centre is a whole number."""
    return msgspec.structs.replace(
        camera,
        width=camera.width // 2,
        height=camera.height // 2,
        fx=camera.fx / 2,
        fy=camera.fy / 2,
        cx=(camera.cx + 0.5) / 2 - 0.5,
        cy=(camera.cy + 0.5) / 2 - 0.5,
    )


class Booted:
    def __init__(self, root: Path, surroundings: Surroundings, options: Sequence[str] = ()) -> None:
        """``options``: further ones of systemd-nspawn."""
        self.around = surroundings
        self._settings = root / "etc" / "terrafix" / "terrafix.toml"
        self.start_here()
        nspawn = ("systemd-nspawn", "--quiet", "-D", str(root), "--register=no", "--keep-unit", *options, "--boot")
        self.process = subprocess.Popen(
            [*nspawn, "--console=pipe"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        wait_until(lambda: bool(children.read_text().split()), "systemd has not started")
        self._init = children.read_text().split()[0]

    def end(self) -> None:
        self.run("systemctl", "poweroff")
        try:
            self.process.wait(timeout=WAIT_S)
        finally:
            self.process.kill()
            self.process.wait()

    def run(self, *words: str) -> str:
        enter = ("nsenter", "-t", self._init, "-m", "-u", "-i", "-n", "-p", "-r", "-w", *words)
        return subprocess.run(enter, capture_output=True, text=True, timeout=WAIT_S, check=False).stdout

    def start_here(self) -> None:
        """The next start of a flight that was stopped in order begins where the vehicle is."""
        self._settings.write_text(self.around.settings())

    def show(self, name: str) -> str:
        return self.run("systemctl", "show", "terrafix", "-p", name, "--value").strip()

    def wait_for(self, name: str, value: str, limit_s: float = WAIT_S) -> float:
        """-> seconds that it took."""
        began_s = time.monotonic()
        wait_until(lambda: self.show(name) == value, f"{name} is not {value}", limit_s)
        return time.monotonic() - began_s

    def wait_for_fix(self, from_s: float) -> None:
        wait_until(lambda: self.around.has_fix(from_s), "no fix")

    def processes(self) -> dict[str, int]:
        """Name and pid of what is in the control group of the unit, without its main process."""
        groups = "for f in $(grep -ls terrafix.service /proc/[0-9]*/cgroup)"
        script = f"{groups}; do cd ${{f%/*}} && echo ${{PWD#/proc/}} $(cat comm); done"
        rows = [line.split() for line in self.run("sh", "-c", script).splitlines()]
        found = {row[1]: int(row[0]) for row in rows if len(row) > 1}
        return {name: pid for name, pid in found.items() if str(pid) != self.show("MainPID")}

    def flying(self) -> dict[str, int]:
        """The processes of a flight that has a fix; waits for it."""
        self.wait_for("ActiveState", "active")
        self.wait_for_fix(time.monotonic() - STEADY_S)
        return {name: pid for name, pid in self.processes().items() if name in NAMES}

    def signal_supervisor(self, name: str) -> None:
        self.run("systemctl", "kill", "-s", name, "--kill-whom=main", "terrafix")

    def run_folders(self) -> list[str]:
        return self.run("sh", "-c", "ls -d /dev/shm/terrafix-*").split()

    def of_systemd(self, since_s: float) -> list[str]:
        """What systemd itself has said about the unit since a time of the wall clock."""
        entries = (e for e in self.journal() if int(e["__REALTIME_TIMESTAMP"]) > 1e6 * since_s)
        return [str(entry["MESSAGE"]) for entry in entries if entry["SYSLOG_IDENTIFIER"] == "systemd"]

    def journal(self) -> list[Any]:
        lines = self.run("journalctl", "-u", "terrafix", "-o", "json", "--no-pager").splitlines()
        return [json.loads(line) for line in lines]


def wait_until(reached: Callable[[], bool], otherwise: str, limit_s: float = WAIT_S) -> None:
    until = time.monotonic() + limit_s
    while not reached():
        assert time.monotonic() < until, otherwise
        time.sleep(0.1)
