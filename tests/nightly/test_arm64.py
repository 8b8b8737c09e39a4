"""Terrafix on ARM64, which a Jetson is: Debian for arm64 in a folder, emulated by qemu, with the wheel by install.sh.

`scripts/arm64` runs it and keeps root and table in out/arm64. Needs root rights and the packages that
scripts/debian-root names; skipped without them. Nothing here measures speed: a frame takes the emulator seconds."""

import csv
import hashlib
import math
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from booted_system import NAMES, Booted, Surroundings, do, slower, wait_until
from emulated_subreaper import as_subreaper
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import MapMatch, NavEstimate, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_lab.chaos.shuttle import shuttle_in

pytestmark = [pytest.mark.nightly, pytest.mark.slow, pytest.mark.real_time]

ROOT = Path(__file__).resolve().parents[2]
SUITE, ARCH = "bookworm", "arm64"
INCLUDED = ("systemd", "systemd-sysv", "dbus", "python3", "python3-venv")
GLIBC_MINOR = 36  # of the suite: wheels for an older glibc run on it
PROCESSOR = "cortex-a76"  # the class of an Orin: no SVE
FAST_TESTS = ("core", "engines", "link", "recorder", "estimator")  # folders of tests/unit
# They measure the memory of the emulator, and count its threads.
NOT_EMULATED = ("page_faults", "memory_is_returned", "free_memory_is_returned", "the_link_gets_real_time_priority")
FRAMES = 20  # of village-1
MAX_APART_M = 0.5  # between the two processors, at any frame
SLOWER = 8.0  # times, of the shuttle: an image each 4 s; a camera without one for 5 s counts as lost
RUN_S, RUN_ESTIMATES, RUN_MATCHES = 1200.0, 5, 2  # limit; of the run with the autopilot at least
LOOK_S = 5.0  # between two looks at the record
# Of its estimates. An emulated frame takes seconds: of a flight without a fix most is dead reckoning, which says so.
RUN_SIGMAS = 3.0
BOOT_S, STEP_S = 1200.0, 7200.0  # limits; the machine may be busy
PYTHON = "/opt/terrafix/venv/bin/python"
TERRAFIX = "/opt/terrafix/venv/bin/terrafix"
UNIT_WORDS = ("run", "--config", "/etc/terrafix/terrafix.toml", "--out", "/var/lib/terrafix/%b")  # of ExecStart=
IMPORTS = """
import importlib, importlib.metadata, importlib.util, pkgutil, platform
import numpy, terrafix, terrafix_engines, terrafix_tools
owners = importlib.metadata.packages_distributions().items()
packages = sorted(name for name, of in owners if name.isidentifier() and not {"pip", "setuptools"} & {*of})
packages = [name for name in packages if importlib.util.find_spec(name)]  # some say that they have more than they have
absent = set()
for name in packages:
    importlib.import_module(name)
ours = (terrafix, terrafix_engines, terrafix_tools)
found = [m.name for p in ours for m in pkgutil.walk_packages(p.__path__, p.__name__ + ".")]
modules = [name for name in found if not name.endswith("__main__")]
for name in modules:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as missing:  # a library of an extra
        assert not missing.name.startswith("terrafix"), missing
        absent.add(missing.name)
    except SystemExit:  # says that an extra is missing
        absent.add(name)
counts = f"{len(packages)} packages, {len(modules)} modules"
print(f"{platform.machine()}: {counts}; not installed: {', '.join(sorted(absent))}")
"""


class Table:
    """What ran, its result, its time and what was seen; printed and written as each row ends."""

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self._path, self._say = path, say
        path.write_text(f"{'what':34} {'result':8} {'minutes':>7}  seen\n")

    @contextmanager
    def row(self, what: str) -> Iterator[list[str]]:
        """What is appended to the list is what was seen. An exception is the result."""
        seen: list[str] = []
        result, began_s = "FAILED", time.monotonic()
        try:
            yield seen
            result = "passed"
        except pytest.skip.Exception as skipped:
            result = "not run"
            seen.append(str(skipped))
            raise
        except (AssertionError, OSError) as error:
            seen.append(str(error).partition("\n")[0])
            raise
        except subprocess.SubprocessError as error:
            last = str(getattr(error, "stderr", None) or getattr(error, "output", None) or error).splitlines()
            seen.append(last[-1] if last else str(error))
            raise
        finally:
            minutes = (time.monotonic() - began_s) / 60.0
            line = f"{what:34} {result:8} {minutes:7.1f}  {'; '.join(seen)}"
            self._say(line)
            with self._path.open("a") as file:
                file.write(line + "\n")


@dataclass(frozen=True)
class EmulatedComputer:
    """The emulated computer: its root folder, whose /trial is ``work`` here."""

    root: Path
    work: Path

    def command(self, *words: str, **variables: str) -> list[str]:
        usual = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LANG": "C.UTF-8", "OMP_NUM_THREADS": "1"}
        setting = [f"{k}={v}" for k, v in (usual | {"QEMU_CPU": PROCESSOR} | variables).items()]
        inside = ["sh", str(ROOT / "scripts" / "in-root"), "--bind", f"{self.work}:/trial", str(self.root)]
        return ["env", "-i", *setting, *inside, *words]

    def do(self, *words: str, **variables: str) -> str:
        return do(*self.command(*words, **variables), limit_s=STEP_S)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the root and the table: TERRAFIX_ARM64, where the root is kept, or a new one."""
    named = os.environ.get("TERRAFIX_ARM64")
    chosen = Path(named).resolve() if named else tmp_path_factory.mktemp("arm64")
    (chosen / "work").mkdir(parents=True, exist_ok=True)
    return chosen


@pytest.fixture(scope="module")
def table(folder: Path, request: pytest.FixtureRequest) -> Table:
    capture = request.config.pluginmanager.getplugin("capturemanager")

    def say(line: str) -> None:
        with capture.global_and_fixture_disabled():
            sys.stdout.write(f"\n{line}\n")
            sys.stdout.flush()

    return Table(folder / "table.txt", say)


@pytest.fixture(scope="module")
def debian(folder: Path, table: Table) -> EmulatedComputer:
    vehicle = EmulatedComputer(folder / "root", folder / "work")
    with table.row("Debian by debootstrap") as seen:
        if platform.machine() != "x86_64":
            pytest.skip(f"ARM64: compares an emulated computer with an x86-64 one, and this is {platform.machine()}")
        made = ["sh", str(ROOT / "scripts" / "debian-root"), SUITE, ARCH, str(vehicle.root), *INCLUDED]
        done = subprocess.run(made, capture_output=True, text=True, timeout=STEP_S, check=False)
        if "root rights" in done.stderr or "package is missing" in done.stderr:
            pytest.skip(f"ARM64 MISSING: {done.stderr.strip()}")
        done.check_returncode()
        seen.append(f"{SUITE} {ARCH}, {vehicle.do('/bin/uname', '-m').strip()}")
    return vehicle


def site_packages(root: Path) -> Path:
    (found,) = (root / "opt/terrafix/venv/lib").glob("python3*/site-packages")
    return found


def pip(*words: str | Path) -> str:
    """pip of this computer, for packages of the other processor where the words say so."""
    return do(sys.executable, "-m", "pip", "--disable-pip-version-check", *words)


def of_the_vehicle() -> list[str]:
    """Options of pip for wheels of the vehicle's processor, Python and C library."""
    glibcs = [f"--platform=manylinux_2_{minor}_aarch64" for minor in range(17, GLIBC_MINOR + 1)]
    return ["--only-binary=:all:", "--platform=manylinux2014_aarch64", *glibcs, "--python-version=3.11"]


@pytest.fixture(scope="module")
def vehicle(debian: EmulatedComputer, table: Table) -> EmulatedComputer:
    """With Terrafix installed by install.sh from its wheel, as on a vehicle without a network."""
    wheels, lock, made = debian.root / "opt" / "wheels", ROOT / "requirements.lock", debian.root / "opt" / "installed"
    with table.row("wheels of aarch64") as seen:
        fresh = debian.root / "opt" / "fresh"
        shutil.rmtree(fresh, ignore_errors=True)
        pip("wheel", "--quiet", "--no-deps", "--wheel-dir", fresh, ROOT, ROOT / "tools")
        (wheel,) = fresh.glob("terrafix-*.whl")
        digest = hashlib.sha256(b"".join(path.read_bytes() for path in sorted(fresh.iterdir()))).hexdigest()
        if made.exists() and made.read_text() == digest:
            seen.append("the same as installed before")
            return debian
        shutil.rmtree(wheels, ignore_errors=True)
        fresh.rename(wheels)
        pip("download", "--quiet", "--dest", wheels, "--constraint", lock, *of_the_vehicle(), wheels / wheel.name)
        seen.append(f"{len(list(wheels.iterdir()))} wheels, none built there")
    with table.row("install.sh --package WHEEL") as seen:
        files = debian.root / "opt" / "files"
        shutil.rmtree(files, ignore_errors=True)
        do(sys.executable, "-m", "terrafix_tools.cli", "files", files)
        if (debian.root / PYTHON.lstrip("/")).is_symlink():
            (site_packages(debian.root) / "extra.pth").unlink(missing_ok=True)
            debian.do(
                PYTHON, "-m", "pip", "uninstall", "--yes", "terrafix", "terrafix-ground"
            )  # the same version, of an older tree
        install = ("sh", "/opt/files/systemd/install.sh", "--package", f"/opt/wheels/{wheel.name}")
        debian.do(*install, PIP_NO_INDEX="1", PIP_FIND_LINKS="/opt/wheels", PIP_NO_COMPILE="1")
        assert (debian.root / TERRAFIX.lstrip("/")).is_file()
        seen.append(debian.do("id", "terrafix").strip())
        made.write_text(digest)
    return debian


@pytest.fixture(scope="module")
def tree(vehicle: EmulatedComputer, table: Table) -> EmulatedComputer:
    """With the tests and what they need beside Terrafix, at the end of the path: what is installed comes first."""
    with table.row("tests and the extra `ground`") as seen:
        extra = vehicle.root / "opt" / "extra"
        wheels = vehicle.root / "opt" / "wheels"
        (wheel,), (ground,) = wheels.glob("terrafix-*.whl"), wheels.glob("terrafix_ground-*.whl")
        if not extra.exists():
            lock = ("--constraint", ROOT / "requirements.lock", "--find-links", wheels, *of_the_vehicle())
            pip("install", "--quiet", "--no-compile", *lock, "--target", f"{extra}.part", f"{wheel}[ground,dev]")
            for own in Path(f"{extra}.part").glob("terrafix*"):
                shutil.rmtree(own)
            Path(f"{extra}.part").rename(extra)
        (site_packages(vehicle.root) / "extra.pth").write_text("/opt/extra\n")
        vehicle.do(PYTHON, "-m", "pip", "install", "--no-deps", f"/opt/wheels/{ground.name}", PIP_NO_INDEX="1")
        tree = vehicle.root / "opt" / "tree"
        shutil.rmtree(tree, ignore_errors=True)
        left_out = shutil.ignore_patterns(".*", "out", "__pycache__", "*.egg-info")
        shutil.copytree(ROOT, tree, ignore=left_out)
        seen.append("the extra's wheels, for the map and the tests")
    return vehicle


def test_all_packages_are_imported(vehicle: EmulatedComputer, table: Table) -> None:
    with table.row("import of all packages") as seen:
        said = vehicle.do(PYTHON, "-c", IMPORTS).splitlines()[-1]
        seen.append(said)
        assert said.startswith("aarch64")


@pytest.mark.parametrize("area", FAST_TESTS)
def test_the_fast_tests_pass(tree: EmulatedComputer, table: Table, area: str) -> None:
    with table.row(f"fast tests of {area}") as seen:
        seen.append(tests_there(tree, f"tests/unit/{area}", PROCESSOR))


def test_no_false_floating_point_flags_with_sve(tree: EmulatedComputer, table: Table) -> None:
    """Of the emulator's largest processor: matrix products of float32 set them, and warnings are errors in tests."""
    with table.row("repeated pictures with SVE") as seen:
        seen.append(tests_there(tree, "tests/unit/vision/test_repeated_picture.py", "max"))


def tests_there(tree: EmulatedComputer, path: str, processor: str) -> str:
    """-> the last line of pytest. Raises AssertionError with its output if a test has failed."""
    chosen = ("-m", "not slow and not real_time and not nightly", "-k", f"not ({' or '.join(NOT_EMULATED)})", path)
    pytest_there = f'cd /opt/tree && exec {PYTHON} -m pytest -q -p no:cacheprovider "$@"'
    command = tree.command("sh", "-c", pytest_there, "pytest", *chosen, QEMU_CPU=processor)
    done = subprocess.run(command, capture_output=True, text=True, timeout=STEP_S, check=False)
    (tree.work / f"{Path(path).stem}.txt").write_text(done.stdout + done.stderr)
    last = done.stdout.splitlines()[-1] if done.stdout else done.stderr
    assert done.returncode == 0, f"{last}\n{done.stdout[-4000:]}"
    return last


def test_map_and_answers_are_those_of_this_computer(
    tree: EmulatedComputer, table: Table, data_set: Callable[[str], Path]
) -> None:
    """Each processor builds its map and replays the same frames over it."""
    flight, tif = data_set("flights/village-1"), data_set("maps/village-2014-01.tif")
    work = tree.work
    shutil.rmtree(work / "flight", ignore_errors=True)
    begin_of(flight, work / "flight")
    shutil.copy(tif, work / "map.tif")

    def build(here: str) -> list[str]:
        return ["map", "build", f"{here}/map.tif", "--date", "2014-01-15", "--out"]

    def replayed(here: str) -> list[str]:
        return ["replay", f"{here}/flight"]

    here = [sys.executable, "-m", "terrafix_tools.cli"]
    with table.row("map build") as seen:
        tree.do(TERRAFIX, *build("/trial"), "/trial/arm64.gpkg")
        do(*here, *build(str(work)), work / "host.gpkg")
        seen.append(f"{(work / 'arm64.gpkg').stat().st_size / 1e6:.1f} MB")
    with table.row(f"replay of {FRAMES} frames") as seen:
        tree.do(TERRAFIX, *replayed("/trial"), "--map", "/trial/arm64.gpkg", "--out", "/trial/arm64")
        do(*here, *replayed(str(work)), "--map", work / "host.gpkg", "--out", work / "host")
        there, expected = (rows_of(work / name) for name in ("arm64", "host"))
        assert len(there) == len(expected) == FRAMES
        largest_m = []
        for kind, prefix in (("immediate", ""), ("refined", "refined_")):
            apart_m = distances_m(there, expected, prefix)
            seen.append(f"{kind}: median {np.median(apart_m):.3f} m, at most {apart_m.max():.3f} m from x86-64")
            largest_m.append(apart_m.max())
        assert max(largest_m) <= MAX_APART_M


def begin_of(flight: Path, folder: Path) -> None:
    """A flight folder with copies of the first frames, without anything of the original's place."""
    (folder / "frames").mkdir(parents=True)
    lines = (flight / "frames.csv").read_text(encoding="utf-8").splitlines()[: FRAMES + 1]
    (folder / "frames.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    shutil.copy(flight / "flight.toml", folder)
    for row in csv.DictReader(lines):
        shutil.copy(flight / "frames" / row["file"], folder / "frames")


def rows_of(out: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((out / "estimates.csv").read_text(encoding="utf-8").splitlines()))


def distances_m(rows: list[dict[str, str]], others: list[dict[str, str]], prefix: str) -> np.ndarray:
    """-> (N,) horizontal distances of the positions of the same frames."""
    apart_m = []
    for row, other in zip(rows, others, strict=True):
        assert row["file"] == other["file"]
        frame = LocalFrame(float(other[f"{prefix}lat_deg"]), float(other[f"{prefix}lon_deg"]))
        apart_m.append(np.hypot(*frame.to_local(float(row[f"{prefix}lat_deg"]), float(row[f"{prefix}lon_deg"]))))
    return np.array(apart_m)


@pytest.fixture(scope="module")
def surroundings(folder: Path) -> Iterator[Surroundings]:
    (folder / "shuttle").mkdir(exist_ok=True)
    scene = slower(shuttle_in(folder / "shuttle", seed=1), SLOWER, folder / "shuttle" / "small")
    with Surroundings(scene) as running:
        yield running


def test_it_flies_with_the_simulated_autopilot(
    vehicle: EmulatedComputer, surroundings: Surroundings, table: Table
) -> None:
    """The link sends no fix by an estimate older than 2 s, as an emulated one is: the record has the estimates."""
    with table.row("terrafix run with the autopilot") as seen:
        surroundings.prepare(vehicle.root)
        (vehicle.root / "etc/terrafix/terrafix.toml").write_text(surroundings.settings())
        out = vehicle.work / "run"
        shutil.rmtree(out, ignore_errors=True)
        before = len(surroundings.peer.received_s)
        start = as_subreaper(vehicle.root, site_packages(vehicle.root))
        words = (*start, TERRAFIX, "run", "--config", "/etc/terrafix/terrafix.toml", "--out", "/trial/run")
        with (
            (vehicle.work / "run.log").open("wb") as log,
            subprocess.Popen(vehicle.command(*words), stdout=log, stderr=subprocess.STDOUT) as process,
        ):
            try:
                wait_until(lambda: process.poll() is not None or enough(out), "too few estimates", RUN_S)
                assert process.poll() is None, "it has ended by itself; see work/run.log"
            finally:
                end(process)
        estimates, matches = flown(out)
        errors_m = [surroundings.error_m(e) for e in estimates]
        sigmas = [error_m / math.sqrt(max(e.cov[0], e.cov[7])) for error_m, e in zip(errors_m, estimates, strict=True)]
        seen.append(f"{len(estimates)} estimates, error at most {max(errors_m):.1f} m, {max(sigmas):.1f} sigma")
        seen.append(f"{matches} map matches, {len(surroundings.peer.received_s) - before} GPS_INPUT")
        assert max(sigmas) < RUN_SIGMAS
        assert "process stopped" in (vehicle.work / "run.log").read_text()


def flown(out: Path) -> tuple[list[NavEstimate], int]:
    """-> the estimates of a record that may be still written, and the number of accepted map matches."""
    messages = [message for _, _, message in read_flight(out)] if list(out.glob("*.mcap")) else []
    accepted = [m for m in messages if isinstance(m, MapMatch) and m.verdict is Verdict.ACCEPTED]
    return [m for m in messages if isinstance(m, NavEstimate)], len(accepted)


def enough(out: Path) -> bool:
    time.sleep(LOOK_S)
    estimates, matches = flown(out)
    return len(estimates) >= RUN_ESTIMATES and matches >= RUN_MATCHES


def end(process: subprocess.Popen[bytes]) -> None:
    """The ordered stop of the first process inside."""
    with suppress(OSError):  # it has ended by itself
        for inside in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
            os.kill(int(inside), signal.SIGTERM)
    try:
        process.wait(timeout=RUN_S)
    finally:
        process.kill()
        process.wait()


def test_the_unit_is_active_in_a_booted_systemd(
    vehicle: EmulatedComputer, surroundings: Surroundings, table: Table
) -> None:
    with table.row("the unit in a booted systemd") as seen:
        if not shutil.which("systemd-nspawn"):
            pytest.skip("ARM64 MISSING: systemd-nspawn (apt install systemd-container)")
        surroundings.prepare(vehicle.root)
        own = vehicle.root / "etc/systemd/system/terrafix.service.d/emulator.conf"
        own.parent.mkdir(parents=True, exist_ok=True)
        words = (*as_subreaper(vehicle.root, site_packages(vehicle.root)), TERRAFIX, *UNIT_WORDS)
        command = " ".join(f"'{word.replace('$', '$$')}'" if " " in word else word for word in words)
        own.write_text(f"[Service]\nEnvironment=QEMU_CPU={PROCESSOR}\nExecStart=\nExecStart={command}\n")
        computer = Booted(vehicle.root, surroundings, ("--setenv", f"QEMU_CPU={PROCESSOR}"))
        try:
            computer.wait_for("ActiveState", "active", BOOT_S)
            wait_until(lambda: set(computer.processes()) >= NAMES, "processes are missing", BOOT_S)
            seen.append(f"active: {computer.show('StatusText')}, restarts {computer.show('NRestarts')}")
            computer.run("systemctl", "stop", "terrafix")
            assert (computer.show("ActiveState"), computer.processes()) == ("inactive", {})
            seen.append(f"stopped: {computer.show('Result')}")
        finally:
            computer.end()
