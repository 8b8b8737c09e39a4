"""The console beside the demo."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import msgspec
import pytest

from terrafix.core.config import load
from terrafix.core.errors import LinkError
from terrafix.processes import PROCESSES
from terrafix.runtime.run_dir import OwnedRunDir, live_runs
from terrafix.runtime.run_spec import spec_of
from terrafix_lab.sim.demo import console
from terrafix_lab.sim.demo.console import DemoConsole, run_of


def test_the_console_of_the_demo_reads_the_run_that_writes_into_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console, "live_runs", lambda: live_runs(tmp_path))
    owned = []
    for name in ("one", "two"):
        spec = spec_of(PROCESSES, load([]), None, tmp_path / name)
        owned.append(OwnedRunDir(tmp_path, msgspec.json.encode(spec)))
    found = run_of(tmp_path / "x" / ".." / "two")
    assert found is not None and found.path == owned[1].run_dir.path
    assert run_of(tmp_path / "three") is None
    with pytest.raises(LinkError, match="nothing to show"):
        DemoConsole(tmp_path / "three").start()
    for one in owned:
        one.remove()


def test_sigterm_ends_the_wait_for_the_console_and_the_console(tmp_path: Path) -> None:
    beside = DemoConsole(tmp_path)
    beside._process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGTERM))
    timer.start()
    beside.wait()
    timer.join()
    assert not beside.runs and beside._process.returncode == -signal.SIGTERM
