"""The unit under a real systemd: Debian in a container of systemd-nspawn, with the wheel where the unit expects it.

Needs root, systemd-nspawn (Debian: systemd-container) and debootstrap, and Debian's packages; skipped without them."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.real_time]

ROOT = Path(__file__).resolve().parents[2]
SUITE, MIRROR = "bookworm", "http://deb.debian.org/debian"
INCLUDED = "systemd,systemd-sysv,dbus,python3"
INSTALL_S, WAIT_S = 1800.0, 300.0  # limits; the machine may be busy
WATCHDOG_S = 10.0  # WatchdogSec= of the unit
STOP_S = 45.0  # TimeoutStopSec= of the unit
SETTINGS = """
[source]
path = "/var/lib/terrafix/flight"
[map]
path = "/var/lib/terrafix/place.gpkg"
"""


def do(*command: str | Path, limit_s: float = INSTALL_S) -> str:
    return subprocess.run([*map(str, command)], check=True, capture_output=True, text=True, timeout=limit_s).stdout


@pytest.fixture(scope="module")
def system(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Debian with Terrafix installed as on a vehicle, a flight and its map."""
    if os.geteuid() or not all(shutil.which(name) for name in ("systemd-nspawn", "debootstrap")):
        pytest.skip("SYSTEMD MISSING: needs root, systemd-nspawn and debootstrap")
    root, work = tmp_path_factory.mktemp("system"), tmp_path_factory.mktemp("work")
    do("debootstrap", "--variant=minbase", f"--include={INCLUDED}", SUITE, root, MIRROR)
    if do("chroot", root, "python3", "-c", "import sys; print(sys.version_info[:2])").strip() != str(
        sys.version_info[:2]
    ):
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
    do(
        sys.executable,
        "-m",
        "terrafix_tools.cli",
        "sim",
        "make",
        "--out",
        work / "flight",
        "--duration",
        "30",
        "--agl",
        "90",
    )
    state = root / "var" / "lib" / "terrafix"
    state.mkdir(parents=True)
    shutil.copytree(work / "flight", state / "flight")
    shutil.copy(next((work / "flight").glob("*.gpkg")), state / "place.gpkg")
    (root / "etc" / "terrafix" / "terrafix.toml").write_text(SETTINGS)
    wanted = root / "etc/systemd/system/multi-user.target.wants"
    wanted.mkdir(parents=True, exist_ok=True)
    (wanted / "terrafix.service").symlink_to("/etc/systemd/system/terrafix.service")
    return root


class Booted:
    def __init__(self, root: Path) -> None:
        nspawn = (
            "systemd-nspawn",
            "--quiet",
            "-D",
            str(root),
            "--register=no",
            "--keep-unit",
            "--private-network",
            "--boot",
        )
        self.process = subprocess.Popen(
            [*nspawn, "--console=pipe"], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL
        )
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        until = time.monotonic() + WAIT_S
        while not children.read_text().split():
            assert time.monotonic() < until
            time.sleep(0.1)
        self._init = children.read_text().split()[0]

    def run(self, *words: str) -> str:
        enter = ("nsenter", "-t", self._init, "-m", "-u", "-i", "-n", "-p", "-r", "-w", *words)
        return subprocess.run(enter, capture_output=True, text=True, timeout=WAIT_S, check=False).stdout

    def show(self, name: str) -> str:
        return self.run("systemctl", "show", "terrafix", "-p", name, "--value").strip()

    def wait_for(self, name: str, value: str) -> float:
        """-> seconds that it took."""
        began_s = time.monotonic()
        while self.show(name) != value:
            assert time.monotonic() - began_s < WAIT_S, f"{name} is {self.show(name)}, not {value}"
            time.sleep(0.2)
        return time.monotonic() - began_s

    def journal(self) -> list[Any]:
        lines = self.run("journalctl", "-u", "terrafix", "-o", "json", "--no-pager").splitlines()
        return [json.loads(line) for line in lines]


@pytest.fixture(scope="module")
def booted(system: Path) -> Iterator[Booted]:
    computer = Booted(system)
    computer.wait_for("ActiveState", "active")
    yield computer
    computer.run("systemctl", "poweroff")
    try:
        computer.process.wait(timeout=WAIT_S)
    finally:
        computer.process.kill()


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


def test_a_supervisor_that_hangs_is_killed_by_the_watchdog_and_started_again(booted: Booted) -> None:
    before = booted.show("MainPID")
    booted.run("systemctl", "kill", "-s", "STOP", "--kill-whom=main", "terrafix")
    assert booted.wait_for("NRestarts", "1") > 0.8 * WATCHDOG_S
    booted.wait_for("ActiveState", "active")
    assert booted.show("MainPID") not in (before, "0")
    assert any("Watchdog timeout" in entry["MESSAGE"] for entry in booted.journal())


def test_a_supervisor_that_is_killed_is_started_again(booted: Booted) -> None:
    before = booted.show("MainPID")
    booted.run("systemctl", "kill", "-s", "KILL", "--kill-whom=main", "terrafix")
    booted.wait_for("NRestarts", "2")
    booted.wait_for("ActiveState", "active")
    assert booted.show("MainPID") not in (before, "0")


def test_a_stop_is_in_order(booted: Booted) -> None:
    began_s = time.monotonic()
    booted.run("systemctl", "stop", "terrafix")
    assert time.monotonic() - began_s < STOP_S
    assert (booted.show("ActiveState"), booted.show("Result")) == ("inactive", "success")
