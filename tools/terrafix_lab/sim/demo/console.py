"""The console beside the demo: `terrafix serve` in a process of its own, which reads the bus of the demo's run."""

import contextlib
import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from terrafix.core.errors import LinkError
from terrafix.runtime.run_dir import RunDir, live_runs
from terrafix.runtime.run_spec import Spec
from terrafix_tools import child_process

PORT = 8700  # that of `terrafix serve`
URL = f"http://127.0.0.1:{PORT}/page/"
STOP_S = 10.0  # longest wait for its end in order


def check_installed() -> None:
    """Raises ModuleNotFoundError, which the command line explains: before the flight, not after it."""
    importlib.import_module("terrafix_tools.console.serve")


def run_of(out: Path) -> RunDir | None:
    """The run on this computer that writes into ``out``."""
    for run in live_runs():
        if os.access(run.path, os.R_OK | os.X_OK) and run.spec.is_file():
            spec = msgspec.json.decode(run.spec.read_bytes(), type=Spec)
            if Path(spec.out_dir).resolve() == out.resolve():
                return run
    return None


class DemoConsole:
    """``start`` once the run exists; ``wait`` until the console is ended with Ctrl-C."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Raises LinkError: there is no run."""
        if self._process is not None:
            return
        run = run_of(self._out)
        if run is None:
            raise LinkError(f"no run writes into {self._out}; the console has nothing to show")
        command = (sys.executable, "-m", "terrafix_tools.program", "serve", "--port", str(PORT))
        folders = ("--data", str(self._out / "console"), "--maps", str(self._out), "--bus", str(run.path))
        with (self._out / "console.log").open("wb") as log:
            self._process = subprocess.Popen((*command, *folders), stdout=log, stderr=log)

    @property
    def runs(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def wait(self) -> None:
        """Until SIGINT or SIGTERM, or until the console ends by itself."""
        if self._process is None:
            return
        process = self._process
        before = signal.signal(signal.SIGTERM, lambda *_: process.terminate())  # it must not wait: this method does
        try:
            with contextlib.suppress(KeyboardInterrupt):
                process.wait()
        finally:
            signal.signal(signal.SIGTERM, before)

    def stop(self) -> None:
        if self._process is None or self._process.poll() is not None:
            return
        child_process.end(self._process, STOP_S)


@contextmanager
def console_beside(out: Path, wanted: bool) -> Iterator[DemoConsole | None]:
    """None unless ``wanted``. Raises ModuleNotFoundError: the extra `console` is not installed."""
    if not wanted:
        yield None
        return
    check_installed()
    beside = DemoConsole(out)
    try:
        yield beside
    finally:
        beside.stop()
