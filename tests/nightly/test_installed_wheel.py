"""The wheel in empty environments outside the source tree: the steps of the README, with and without the extras.

`demo` and `map build` run where the extra `ground` is installed, everything that flies where it is not: the
environment of the aircraft has no GDAL."""

import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

pytestmark = [pytest.mark.nightly, pytest.mark.slow]  # downloads, and minutes

ROOT = Path(__file__).resolve().parents[2]
INSTALL_S, STEP_S = 1200.0, 600.0  # limits; the machine may be busy
GROUND_PORT = 14551  # of config/ground-station.toml


class Installed:
    """The command `terrafix` of a virtual environment of its own, run in ``work`` with nothing of the source tree."""

    def __init__(self, folder: Path, wheels: Path, name: str, work: Path) -> None:
        """``name``: what is installed from the folder ``wheels``, with its extras."""
        self.python, self._command, self._work = folder / "bin" / "python", folder / "bin" / "terrafix", work
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, timeout=INSTALL_S)
        pip = [str(self.python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        lock = ["--constraint", str(ROOT / "requirements.lock"), "--find-links", str(wheels)]
        subprocess.run([*pip, *lock, name], check=True, timeout=INSTALL_S)
        self._environment = {"PATH": "/usr/bin:/bin", "HOME": str(work), "LANG": "C.UTF-8", "OMP_NUM_THREADS": "1"}

    def run(self, *words: str) -> subprocess.CompletedProcess[str]:
        command = [str(self._command), *words]
        return subprocess.run(
            command, cwd=self._work, env=self._environment, capture_output=True, text=True, timeout=STEP_S, check=False
        )

    def do(self, line: str) -> str:
        """Output of a command that has to succeed, as it is written in the README."""
        done = self.run(*line.split())
        assert done.returncode == 0, f"{line}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
        assert "Traceback" not in done.stderr
        return done.stdout

    @contextmanager
    def beside(self, line: str) -> Iterator[None]:
        command = [str(self._command), *line.split()]
        with subprocess.Popen(command, cwd=self._work, env=self._environment) as process:
            try:
                yield
            finally:
                process.terminate()
        assert process.returncode == 0, "it ends in order"


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("work")


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two wheels of the project."""
    folder = tmp_path_factory.mktemp("wheels")
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(folder)]
    subprocess.run([*pip, str(ROOT), str(ROOT / "tools")], check=True, timeout=INSTALL_S)
    return folder


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory, wheels: Path, work: Path) -> Installed:
    return Installed(tmp_path_factory.mktemp("aircraft"), wheels, "terrafix", work)


@pytest.fixture(scope="module")
def ground(tmp_path_factory: pytest.TempPathFactory, wheels: Path, work: Path) -> Installed:
    """With the flight of the demo and its map in ``work``/out, as the README has them."""
    installed = Installed(tmp_path_factory.mktemp("ground"), wheels, "terrafix[ground,console]", work)
    installed.do("demo --duration 30")
    installed.do("map build out/demo/map.tif --dem out/demo/dem.tif --date 2020-07-10 --out out/place.gpkg")
    return installed


def test_the_aircrafts_environment_has_neither_gdal_nor_a_web_server_nor_the_lab(aircraft: Installed) -> None:
    names = ("rasterio", "fastapi", "dask", "terrafix_lab", "terrafix_tools.console")
    code = f"import importlib.util as u; print([n for n in {names} if u.find_spec(n)])"
    done = subprocess.run([str(aircraft.python), "-I", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    refused = aircraft.run("map", "build", "nowhere.tif", "--out", "out/nowhere.gpkg")
    assert refused.returncode == 2 and "[ground]'" in refused.stderr


@pytest.mark.parametrize(
    ("place", "some"),
    [("aircraft", {"run", "replay", "report", "preflight"}), ("ground", {"run", "fleet", "serve", "demo", "bench"})],
)
def test_every_command_explains_itself(request: pytest.FixtureRequest, place: str, some: set[str]) -> None:
    installed: Installed = request.getfixturevalue(place)
    commands = [
        line.split()[1] for line in installed.do("--help").splitlines() if line.startswith("│ ") and line[2] > " "
    ]
    commands = [name for name in commands if name[0] != "-"]
    assert some <= set(commands)
    for name in commands:
        installed.do(f"{name} --help")


def test_a_flight_is_replayed_evaluated_and_reported_without_gdal(
    aircraft: Installed, ground: Installed, work: Path
) -> None:
    aircraft.do("replay out/demo/flight --map out/place.gpkg --out out/replay")
    assert "ellipse95_coverage" in aircraft.do("evaluate out/replay --truth out/demo/flight/truth.csv")
    aircraft.do("report out/replay --truth out/demo/flight/truth.csv")
    assert "<svg" in (work / "out/replay/report.html").read_text(encoding="utf-8")
    ground.do("finalise out/replay")
    assert (work / "out/replay/finalised.csv").is_file()


@pytest.mark.usefixtures("ground")
def test_a_ground_station_sees_the_position_of_a_run(aircraft: Installed, work: Path) -> None:
    aircraft.do("files files")
    run = "run --source out/demo/flight --map out/place.gpkg"
    with received(GROUND_PORT) as seen:
        aircraft.do(f"{run} --config files/config/ground-station.toml --until-end --out out/run")
    assert seen["HEARTBEAT"] >= 20
    assert seen["GLOBAL_POSITION_INT"] >= 20, "twice a second, while it has a fix"
    assert "process stopped" in aircraft.do("log lines out/run")


@contextmanager
def received(port: int) -> Iterator[Counter[str]]:
    """Names of the messages of system 201 that reach this port, while the body runs."""
    seen: Counter[str] = Counter()
    parser, ended = mavlink.MAVLink(None), threading.Event()

    def listen() -> None:
        while not ended.is_set():
            try:
                packet = listener.recv(4096)
            except TimeoutError:
                continue
            seen.update(m.get_type() for m in parser.parse_buffer(packet) or () if m.get_srcSystem() == 201)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listener:
        listener.bind(("127.0.0.1", port))
        listener.settimeout(0.2)
        thread = threading.Thread(target=listen)
        thread.start()
        try:
            yield seen
        finally:
            ended.set()
            thread.join()


def test_the_console_takes_a_flight_over_its_map(ground: Installed) -> None:
    url = "http://127.0.0.1:18799"
    with ground.beside("serve --port 18799 --data out/console --maps out"):
        until = time.monotonic() + STEP_S
        while ground.run("flight", "list", "--url", url).returncode != 0:
            assert time.monotonic() < until
            time.sleep(0.5)
        assert ground.do(f"flight create out/demo/flight/flight.toml --map place --url {url}").strip()
