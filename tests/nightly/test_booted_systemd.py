"""The unit under a real systemd: Debian in a container of systemd-nspawn, with the wheel where the unit expects it.

The container has the loopback of this computer, where a simulated camera and autopilot fly the shuttle of the soak.
Needs root, systemd-nspawn (Debian: systemd-container) and debootstrap, and Debian's packages; skipped without them."""

import os
import shutil
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from booted_system import NAMES, Booted, Surroundings, do, wait_until
from terrafix_lab.chaos.shuttle import shuttle_in

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.real_time]

ROOT = Path(__file__).resolve().parents[2]
SUITE, ARCH = "bookworm", "amd64"
INCLUDED = ("systemd", "systemd-sysv", "dbus", "python3")
WATCHDOG_S = 10.0  # WatchdogSec= of the unit
STOP_S = 45.0  # TimeoutStopSec= of the unit
ALONE_S = 10.0  # after which a process without a supervisor ends (runtime/adopted_process.py)
SILENCE_S = 2.0  # without GPS_INPUT; the start of new processes costs more than 4 s


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
    surroundings.prepare(root)
    return root


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
