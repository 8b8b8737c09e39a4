"""The unit under a real systemd: Debian in a container of systemd-nspawn, with the wheel where the unit expects it.

The container has the loopback of this computer, where a simulated camera and autopilot fly the shuttle of the soak.
Needs root, systemd-nspawn (Debian: systemd-container) and debootstrap, and Debian's packages; skipped without them."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from terrafix.processes import PROCESSES
from terrafix_tools.chaos.camera import StreamedCamera, camera_toml
from terrafix_tools.chaos.scene import Scene
from terrafix_tools.chaos.shuttle import shuttle_in
from terrafix_tools.chaos.verdict import back_s, silence_s
from terrafix_tools.sim.autopilot.parameters import Kind
from terrafix_tools.sim.autopilot.peer import AutopilotPeer
from terrafix_tools.sim.camera.stream import FrameStream

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.real_time]

ROOT = Path(__file__).resolve().parents[2]
SUITE, ARCH = "bookworm", "amd64"
INCLUDED = ("systemd", "systemd-sysv", "dbus", "python3")
INSTALL_S, WAIT_S = 1800.0, 300.0  # limits; the machine may be busy
WATCHDOG_S = 10.0  # WatchdogSec= of the unit
STOP_S = 45.0  # TimeoutStopSec= of the unit
ALONE_S = 10.0  # after which a process without a supervisor ends (runtime/adopted_process.py)
SILENCE_S = 2.0  # without GPS_INPUT; the start of new processes costs more than 4 s
STEADY_S = 1.0  # with a fix before each fault
NAMES = {process.name for process in PROCESSES}


def do(*command: str | Path, limit_s: float = INSTALL_S) -> str:
    return subprocess.run([*map(str, command)], check=True, capture_output=True, text=True, timeout=limit_s).stdout


class Surroundings:
    """Camera and autopilot of the shuttle on the loopback of this computer. A context manager."""

    def __init__(self, scene: Scene) -> None:
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

    def has_fix(self, from_s: float) -> bool:
        """Whether there is a 3D fix, since at least STEADY_S and after ``from_s`` (monotonic)."""
        now_s = time.monotonic()
        back = back_s([fix.received_s for fix in self.peer.fixes()[-1000:]], from_s, now_s)
        return back is not None and now_s - (from_s + back) > STEADY_S

    def silence_s(self, from_s: float) -> float:
        """Longest time without GPS_INPUT from ``from_s`` to now."""
        return silence_s(self.peer.received_s, from_s, time.monotonic())


@pytest.fixture(scope="module")
def surroundings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Surroundings]:
    with Surroundings(shuttle_in(tmp_path_factory.mktemp("shuttle"), seed=1)) as running:
        yield running


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory, surroundings: Surroundings) -> Path:
    """Debian with Terrafix installed as on a vehicle, with the map of the shuttle and its settings."""
    if os.geteuid() or not all(shutil.which(name) for name in ("systemd-nspawn", "debootstrap")):
        pytest.skip("SYSTEMD MISSING: needs root, systemd-nspawn and debootstrap")
    root = tmp_path_factory.mktemp("system")
    do("sh", ROOT / "scripts" / "debian-root", SUITE, ARCH, root, *INCLUDED)
    of_debian = do("chroot", root, "python3", "-c", "import sys; print(sys.version_info[:2])").strip()
    if of_debian != str(sys.version_info[:2]):
        pytest.skip(f"SYSTEMD MISSING: the Python of Debian {SUITE} is another one than that of the test")
    venv = root / "opt" / "terrafix" / "venv"
    do("chroot", root, "python3", "-m", "venv", "--without-pip", "/opt/terrafix/venv")
    (site,) = (venv / "lib").glob("python3*/site-packages")
    lock = ("--constraint", ROOT / "requirements.lock")
    do(sys.executable, "-m", "pip", "install", "--quiet", *lock, "--target", site, f"{ROOT}[vehicle]")
    command = venv / "bin" / "terrafix"
    command.write_text("#!/opt/terrafix/venv/bin/python\nfrom terrafix_tools.program import main\nmain()\n")
    command.chmod(0o755)
    do("sh", ROOT / "systemd" / "install.sh", "--prefix", root, "--no-pip")
    maps = root / "var" / "lib" / "terrafix" / "maps"
    maps.mkdir(parents=True)
    shutil.copy(surroundings.scene.map_path, maps / "place.gpkg")
    (root / "etc" / "terrafix" / "camera.toml").write_text(camera_toml(surroundings.scene.camera))
    wanted = root / "etc/systemd/system/multi-user.target.wants"
    wanted.mkdir(parents=True, exist_ok=True)
    (wanted / "terrafix.service").symlink_to("/etc/systemd/system/terrafix.service")
    return root


class Booted:
    def __init__(self, root: Path, surroundings: Surroundings) -> None:
        self.around = surroundings
        self._settings = root / "etc" / "terrafix" / "terrafix.toml"
        self.start_here()
        nspawn = ("systemd-nspawn", "--quiet", "-D", str(root), "--register=no", "--keep-unit", "--boot")
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

    def wait_for(self, name: str, value: str) -> float:
        """-> seconds that it took."""
        began_s = time.monotonic()
        wait_until(lambda: self.show(name) == value, f"{name} is not {value}")
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


@pytest.fixture(scope="module")
def booted(system: Path, surroundings: Surroundings) -> Iterator[Booted]:
    computer = Booted(system, surroundings)
    try:
        computer.wait_for("ActiveState", "active")
        yield computer
    finally:
        computer.end()


@pytest.fixture
def flight(booted: Booted) -> Booted:
    """Active and with a fix, also after a test that has stopped it."""
    if booted.show("ActiveState") != "active":
        booted.start_here()
        booted.run("systemctl", "start", "terrafix")
    assert set(booted.flying()) == NAMES
    return booted


def test_the_unit_is_active_when_all_processes_are_ready(booted: Booted) -> None:
    assert booted.show("StatusText").startswith("flying")
    assert booted.show("NRestarts") == "0"
    assert booted.show("WatchdogUSec") == "10s"
    user = booted.run("id", "-u", "terrafix").strip()
    assert f"\nUid:\t{user}\t" in booted.run("cat", f"/proc/{booted.show('MainPID')}/status"), "no root"


def test_entries_of_the_journal_have_the_fields_of_their_line(booted: Booted) -> None:
    started = [entry for entry in booted.journal() if entry["MESSAGE"].startswith("process started")]
    assert {entry["TERRAFIX_CHILD"] for entry in started} >= {"vision", "anchor", "estimator", "link", "recorder"}
    assert {entry["TERRAFIX_PROCESS"] for entry in started} == {"supervisor"}
    assert {entry["SYSLOG_IDENTIFIER"] for entry in started} == {"terrafix"}


def test_the_processes_of_a_killed_supervisor_fly_on_and_the_next_one_adopts_them(flight: Booted) -> None:
    processes, main, restarts = flight.flying(), flight.show("MainPID"), int(flight.show("NRestarts"))
    began_s = time.monotonic()
    flight.signal_supervisor("KILL")
    flight.wait_for("NRestarts", str(restarts + 1))
    assert flight.flying() == processes, "the same pids"
    assert flight.show("MainPID") not in (main, "0")
    assert flight.around.silence_s(began_s) < SILENCE_S


def test_a_supervisor_that_hangs_is_killed_by_the_watchdog_and_its_processes_fly_on(flight: Booted) -> None:
    processes, restarts = flight.flying(), int(flight.show("NRestarts"))
    began_s = time.monotonic()
    flight.signal_supervisor("STOP")
    assert flight.wait_for("NRestarts", str(restarts + 1)) > 0.8 * WATCHDOG_S
    assert flight.flying() == processes, "the same pids"
    assert flight.around.silence_s(began_s) < SILENCE_S
    assert any("Watchdog timeout" in entry["MESSAGE"] for entry in flight.journal())


def test_a_restart_stops_all_processes_in_order_and_starts_others(flight: Booted) -> None:
    before = flight.flying()
    flight.start_here()
    began_s = time.time()
    flight.run("systemctl", "restart", "terrafix")
    assert not set(flight.flying().values()) & set(before.values())
    assert len(flight.run_folders()) == 1
    assert not [line for line in flight.of_systemd(began_s) if "left-over" in line or "remains running" in line]


def test_a_stop_ends_all_processes_in_order(flight: Booted) -> None:
    began_s = time.monotonic()
    flight.run("systemctl", "stop", "terrafix")
    assert time.monotonic() - began_s < STOP_S
    assert (flight.show("ActiveState"), flight.show("Result")) == ("inactive", "success")
    assert (flight.processes(), flight.run_folders()) == ({}, [])


def test_processes_whose_supervisor_was_killed_just_before_a_stop_end_by_themselves(flight: Booted) -> None:
    flight.run("sh", "-c", "systemctl kill -s KILL --kill-whom=main terrafix; sleep 0.05; systemctl stop terrafix")
    began_s = time.monotonic()
    assert flight.show("ActiveState") in ("inactive", "failed")
    assert set(flight.processes()) >= NAMES, "the kill came before the stop"
    wait_until(lambda: not flight.processes(), "processes are left", ALONE_S + STOP_S)
    assert time.monotonic() - began_s > 0.5 * ALONE_S
    left = flight.run_folders()
    flight.run("systemctl", "start", "terrafix")
    assert flight.run_folders() == left, "the next start goes on in the folder that they left"
