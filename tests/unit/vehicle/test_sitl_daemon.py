"""Terrafix as a child of a SITL flight: it ends with the flight, however the flight ends."""

import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import small_map
from link_port import free_port

pytest.importorskip("mavsdk", reason="mavsdk is not installed (pip install 'terrafix[sim]')")

from terrafix.processes import PROCESSES
from terrafix_lab.sim.sitl import stages
from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.stages import Daemon

pytestmark = pytest.mark.real_time

ENDS_S = 30.0  # some seconds on a quiet machine

FLIGHT = """
import sys, time
from pathlib import Path
from types import SimpleNamespace
from terrafix_lab.sim.sitl.firmware import Home
from terrafix_lab.sim.sitl.stages import Daemon
scene = SimpleNamespace(home=Home(48.0002, 11.0002, 500.0, 90.0), map_path=Path(sys.argv[2]))
with Daemon(Path(sys.argv[1]), scene, sys.argv[3], sys.argv[4]) as daemon:
    daemon.start()
    time.sleep(600)
"""

DEAF = """
import signal, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
print("deaf", flush=True)
time.sleep(60)
"""


def eventually(holds: Any, within_s: float) -> None:
    until_s = time.monotonic() + within_s
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.05)


def test_terrafix_stops_in_order_when_its_flight_is_killed(tmp_path: Path) -> None:
    """The camera outlives the flight and sends nothing, and the link has no autopilot: no process gives up before."""
    log = tmp_path / "terrafix.log"
    with socket.create_server(("127.0.0.1", 0)) as camera:
        source, link = f"http://127.0.0.1:{camera.getsockname()[1]}/", f"udpin:127.0.0.1:{free_port()}"
        command = [sys.executable, "-c", FLIGHT, str(tmp_path), str(small_map.write(tmp_path)), source, link]
        with subprocess.Popen(command) as flight:
            eventually(lambda: log.exists() and log.read_text().count("process started") == len(PROCESSES), 60.0)
            flight.kill()
        eventually(lambda: log.read_text().count("process stopped") == len(PROCESSES), ENDS_S)
    assert "SIGTERM" not in log.read_text(), "no process was killed because it went on waiting for the camera"


def test_a_terrafix_that_ignores_sigterm_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stages, "STOP_S", 0.2)
    scene: Any = SimpleNamespace(home=Home(48.0, 11.0, 500.0, 90.0), map_path=tmp_path / "map.gpkg")
    with Daemon(tmp_path, scene, "http://127.0.0.1:9/", "udpin:127.0.0.1:0") as daemon:
        daemon._command = [sys.executable, "-c", DEAF]
        daemon.start()
        eventually(lambda: "deaf" in (tmp_path / "terrafix.log").read_text(), 20.0)
        process: Any = daemon._process
    assert process.returncode == -9
