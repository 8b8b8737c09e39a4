"""One line a second in the terminal of `terrafix run`: where it is and why."""

import sys
import threading
from collections.abc import Callable
from typing import Any, TextIO

from terrafix.core.clock import now_ns
from terrafix.messages import GpsInput, Health, LinkStatus, Message, NavEstimate, SearchState
from terrafix.processes import PROCESSES
from terrafix.runtime.observer import Observer
from terrafix.runtime.run_dir import RunDir
from terrafix_tools.status.facts import facts
from terrafix_tools.status.processes import process_states
from terrafix_tools.status.screen import SOURCES
from terrafix_tools.status.state import Status

KINDS: tuple[type[Message], ...] = (GpsInput, NavEstimate, LinkStatus, SearchState, Health)
PERIOD_S = 1.0
POLL_MS = 200


def line_of(found: dict[str, Any]) -> str:
    """``found``: the result of facts.facts. -> "3D fix to 2.1 m, 48.123456 11.234567, ..." or why there is none."""
    position, autopilot = found["position"], found["autopilot"]
    if position["fix"] == "3D":
        parts = [f"3D fix to {position['accuracy_m']} m"]
    else:
        parts = [f"no fix: {position['reason'] or 'not known why'}"]
    if "lat_deg" in position:
        parts.append(f"{position['lat_deg']:.6f} {position['lon_deg']:.6f}, {position['agl_m']:.0f} m above ground")
        parts.append(f"by {SOURCES[position['source']]}, 95 % within {position['radius_95_m']} m")
    if position["search"] not in (None, "normal", "skip"):
        parts.append(f"search: {position['search']}")
    parts.append(f"{autopilot['autopilot']} connected" if autopilot["connected"] else "no autopilot")
    down = [process["name"] for process in found["processes"] if process["state"] != "running"]
    return ", ".join([*parts, *([f"without {' '.join(down)}"] if down else [])])


def print_lines(run: RunDir, stream: TextIO, stopping: Callable[[], bool]) -> None:
    """Prints a line each PERIOD_S until ``stopping()``."""
    with Observer(run, KINDS, PROCESSES) as observer:
        status, due_ns = Status(now_ns()), now_ns()
        while not stopping():
            for message in observer.receive(POLL_MS):
                status.take(now_ns(), message)
            if now_ns() >= due_ns and run.spec.exists():
                due_ns = now_ns() + round(PERIOD_S * 1e9)
                stream.write(line_of(facts(status, process_states(run, now_ns()), now_ns())) + "\n")
                stream.flush()


class RunLine:
    """The line of a run, in a thread. A context manager; ``start`` is called with the run folder, once it exists."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Prints nothing if the stream (stderr) is no terminal."""
        self._stream = stream or sys.stderr
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, run: RunDir) -> None:
        if self._stream.isatty():
            arguments = (run, self._stream, self._stopping.is_set)
            self._thread = threading.Thread(target=print_lines, args=arguments, name="run-line", daemon=True)
            self._thread.start()

    def __enter__(self) -> "RunLine":
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
