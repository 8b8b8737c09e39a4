"""The real processes of Terrafix beside a simulated camera and autopilot, with access to all that may fail."""

import math
import os
import signal
import subprocess
import sys
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix.messages import Origin
from terrafix.runtime.run_dir import PREFIX, SHM, write_atomic
from terrafix_lab.chaos.camera import StreamedCamera, camera_toml
from terrafix_lab.chaos.console import Console
from terrafix_lab.chaos.memory_group import MemoryGroup
from terrafix_lab.chaos.scene import ChaosScene
from terrafix_lab.chaos.serial_line import SerialLine
from terrafix_lab.chaos.switches import Switches
from terrafix_lab.faults.edits import OriginEdit, unchanged_origin
from terrafix_lab.faults.fault import Need
from terrafix_lab.faults.processes import COOL_MC, SUPERVISOR
from terrafix_lab.sim.autopilot.course import PeerState
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.sim.camera.mount import mount_of
from terrafix_lab.sim.camera.stream import FrameStream
from terrafix_tools import child_process

RESTART_S = 0.1  # RestartSec= of the systemd unit, whose part the rig takes
START_LIMIT_S = 90.0  # until the camera is opened, on a computer that others use too
STOP_LIMIT_S = 45.0  # TimeoutStopSec= of the unit
START_SIGMA_M = 10.0  # of the start, which `terrafix run` states itself
RATE_HZ = 20.0  # of images that are taken at most, where the camera is not faster
SHARED_MB = 128  # shared memory of its own: frames take 18 MB, and descriptors of the map some more
NONE = Path()


class Rig:
    """One start of Terrafix in a folder. A context manager, which stops all that it has started."""

    def __init__(
        self,
        scene: ChaosScene,
        folder: Path,
        start_s: float,
        *,
        seed: int,
        needs: Collection[Need] = (),
        model: Path = NONE,
        origin: OriginEdit = unchanged_origin,
    ) -> None:
        """``start_s``: second of the flight at which it begins; ``needs``: what it has beside the usual, with ``model``
        the weights of XFeat; ``origin``: edits the stated start and camera.

        ``folder`` is new; the record is in its folder ``out``. Raises OSError."""
        self.scene, self.folder = scene, folder
        self.out: Path = folder / "out"
        self.map_path: Path = folder / "map.gpkg"
        self.began_s: float | None = None  # monotonic time of ``start_s``; None: the vehicle is held in the air
        self.busy: list[subprocess.Popen[bytes]] = []  # other programs that a fault has started
        self._start_s, self._origin = start_s, origin
        folder.mkdir(parents=True)
        self.out.mkdir()
        self.map_path.write_bytes(scene.map_path.read_bytes())
        self.set_temperature(COOL_MC)
        self.peer: AutopilotPeer = AutopilotPeer(
            seed=seed,
            kind=scene.kind,
            home_amsl_m=self._home_amsl_m(),
            aligned=not scene.disarmed,
            mount=mount_of(scene.camera),
        )
        self.stream = FrameStream()
        self.camera = StreamedCamera(self.stream, scene.jpeg, self.flight_s, scene.frame_hz)
        self.switches = Switches(folder / "switches")
        self.model_path = folder / "xfeat.onnx"
        if Need.MODEL in needs:
            self.model_path.write_bytes(model.read_bytes())
        self._needs = needs
        self.memory_group = MemoryGroup()
        self.line: SerialLine | None = None
        self.console: Console | None = None  # from the take-off on
        self._died_s: float | None = None
        self._daemon: subprocess.Popen[bytes] | None = None
        self.stop_s: float | None = None  # that the ordered stop took
        self.starts = 0

    def __enter__(self) -> "Rig":
        port = self.peer.start(0, self._state, self.flight_s)
        self.camera.__enter__()
        if Need.SERIAL in self._needs:
            self.line = SerialLine(port).__enter__()
        self._write_config(port)
        self._start()
        return self

    def __exit__(self, *_: object) -> None:
        for program in self.busy:
            program.kill()
            program.wait()
        if self.console is not None:
            self.console.end()
        self.memory_group.lift()
        self.stop()
        self.camera.__exit__()
        self.stream.close()
        if self.line is not None:
            self.line.__exit__()
        with suppress(RuntimeError):
            self.peer.stop()

    def take_off(self) -> None:
        """The flight begins when the camera is opened. Raises SourceError."""
        until_s = time.monotonic() + START_LIMIT_S
        while not self.stream.wait_for_viewer(0.1):
            self.check()
            if time.monotonic() > until_s or self._ended_by_itself():
                raise SourceError(f"{self.folder}: Terrafix has not started; see {self.log}")
        if Need.CONSOLE in self._needs:
            self.console = Console(next(self.run_folders()), self.folder)
        self.began_s = time.monotonic()

    def flight_s(self) -> float:
        """Second of the flight."""
        return self._start_s + (0.0 if self.began_s is None else time.monotonic() - self.began_s)

    @property
    def log(self) -> Path:
        return self.folder / "terrafix.log"

    @property
    def supervisor_pid(self) -> int | None:
        return None if self._daemon is None or self._daemon.poll() is not None else self._daemon.pid

    def pid(self, process: str) -> int | None:
        """Of a process of Terrafix by its name in `ps`, or of the "supervisor"; None: it does not run."""
        if process == SUPERVISOR:
            return self.supervisor_pid
        return next((pid for name, pid in self.processes() if name == process), None)

    def processes(self) -> Iterator[tuple[str, int]]:
        """Name and pid of the children of the supervisor, and of the processes that outlived the one before it."""
        outlived = {int(word) for run in self.run_folders() for word in _first_words(run.glob("*.pid"))}
        for entry in Path("/proc").iterdir():
            with suppress(OSError, ValueError, IndexError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                if parent == self.supervisor_pid or int(entry.name) in outlived:
                    yield (entry / "comm").read_text().strip(), int(entry.name)

    def run_folders(self) -> Iterator[Path]:
        """The run folder in shared memory; none before the supervisor has made it."""
        for spec in self.shared_memory.glob(f"{PREFIX}*/spec.json"):
            with suppress(OSError):
                if str(self.out) in spec.read_text():
                    yield spec.parent

    @property
    def shared_memory(self) -> Path:
        """Of its own (Need.SHARED_MEMORY) while the supervisor runs, or the one of the computer."""
        own = Need.SHARED_MEMORY in self._needs and self.supervisor_pid is not None
        return Path(f"/proc/{self.supervisor_pid}/root{SHM}") if own else SHM

    def kill_all(self) -> None:
        """Kills the supervisor and all processes, as the out-of-memory killer of a control group does."""
        pids = [self.supervisor_pid, *(pid for _, pid in self.processes())]
        for pid in pids:
            if pid is not None:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)

    def signal(self, process: str, number: int) -> None:
        """Sends a signal to a process (names as in ``pid``)."""
        pid = self.pid(process)
        if pid is not None:
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def check(self) -> None:
        """Starts Terrafix again if its supervisor has died, as systemd does. Call it often."""
        if self._daemon is None or self._daemon.poll() is None:
            return
        if self._died_s is None:
            self._died_s = time.monotonic()
        elif time.monotonic() - self._died_s > RESTART_S:
            self._start()

    def set_temperature(self, millidegrees: int) -> None:
        zone = self.folder / "sys" / "class" / "thermal" / "thermal_zone0"
        zone.mkdir(parents=True, exist_ok=True)
        (zone / "type").write_text("cpu-thermal\n")
        write_atomic(zone / "temp", f"{millidegrees}\n".encode())  # a file of sysfs is never half written

    def stop(self) -> None:
        """The ordered stop."""
        if self._daemon is None:
            return
        began_s = time.monotonic()
        self._daemon.send_signal(signal.SIGCONT)
        child_process.end(self._daemon, STOP_LIMIT_S)
        self.stop_s = time.monotonic() - began_s
        self._daemon = None

    def _ended_by_itself(self) -> bool:
        """Whether it ended again and again before it opened the camera."""
        return self.starts > 3 and self._daemon is not None and self._daemon.poll() is not None

    def _start(self) -> None:
        self._died_s = None
        self.starts += 1
        command = [sys.executable, "-m", "terrafix_lab.sim.sitl.child_process", str(os.getpid()), "run"]
        command += ["--config", str(self.folder / "terrafix.toml"), "--out", str(self.out)]
        if Need.SHARED_MEMORY in self._needs:
            mount = f'mount -t tmpfs -o size={SHARED_MB}m tmpfs {SHM} && exec "$@"'
            command = ["unshare", "--mount", "sh", "-c", mount, "sh", *command]
        environment = self.switches.environment() if Need.SWITCHES in self._needs else None
        with self.log.open("ab") as log:
            self._daemon = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, env=environment)

    def _write_config(self, port: int) -> None:
        first = self._state(self._start_s)
        stated = self._origin(
            Origin(
                t_ns=0,
                camera=self.scene.camera,
                lat_deg=first.lat_deg,
                lon_deg=first.lon_deg,
                ground_amsl_m=None,
                start_sigma_m=START_SIGMA_M,
                yaw_sigma_deg=0.0,
                agl_sigma_m=0.0,
                attitude_sigma_deg=0.0,
            )
        )
        start = f'start = "{stated.lat_deg:.6f},{stated.lon_deg:.6f}"\n' if math.isfinite(stated.start_sigma_m) else ""
        camera, rate_hz = self.folder / "camera.toml", max(RATE_HZ, self.scene.frame_hz)
        camera.write_text(camera_toml(stated.camera, self.scene.attitude_sigma_deg))
        (self.folder / "terrafix.toml").write_text(
            f'[map]\npath = "{self.map_path}"\n'
            f'[source]\npath = "{self.stream.url}"\ncamera = "{camera}"\nrate_hz = {rate_hz}\n'
            f"{start}"
            f'[link]\ndevice = "{self.line.device if self.line else f"udpout:127.0.0.1:{port}"}"\n'
            f'[health]\nsysfs_root = "{self.folder / "sys"}"\n'
            f'[recorder]\nframes = "none"\n'
            + (f'[models]\nxfeat = "{self.model_path}"\n' if Need.MODEL in self._needs else "")
        )

    def _state(self, t_s: float) -> PeerState:
        return self.scene.course(t_s)

    def _home_amsl_m(self) -> float:
        ground = self.scene.course(0.0)
        return ground.amsl_m - ground.agl_m


def _first_words(files: Iterable[Path]) -> Iterator[str]:
    for file in files:
        with suppress(OSError):
            yield from file.read_text().split()[:1]
