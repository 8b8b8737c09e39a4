"""Flight of the demo: the supervisor and its processes, and the autopilot peer."""

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from terrafix.messages import ProcessEvent
from terrafix.runtime import supervisor
from terrafix_lab.sim.autopilot.course import PeerState, peer_state_of
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.sim.autopilot.report import PeerReport
from terrafix_lab.sim.flights.folder import Flight

LOG = "autopilot.tlog"  # what the autopilot sent, for `terrafix log autopilot`
POLL_S = 1.0  # polling interval of the autopilot's status
LOG_INTERVAL_S = 15.0  # interval of status lines on a non-interactive console


class FlightClock:
    """Seconds of the flight. They start with the source's clock, which is known when the source is open."""

    def __init__(self) -> None:
        self._epoch_ns: int | None = None

    def start(self, epoch_ns: int) -> None:
        """``epoch_ns``: the source's time zero on the monotonic clock, which the peer uses too."""
        self._epoch_ns = epoch_ns

    @property
    def runs(self) -> bool:
        return self._epoch_ns is not None

    def __call__(self) -> float:
        """Zero until the clock runs."""
        return 0.0 if self._epoch_ns is None else max(0.0, (time.monotonic_ns() - self._epoch_ns) / 1e9)


class Course:
    """True course of the flight for the peer, which adds its own sensor errors.

    At time zero the vehicle is held in the air: the clock does not run while the processes start.
    """

    def __init__(self, flight: Flight) -> None:
        self._flight = flight

    def __call__(self, t_s: float) -> PeerState:
        state = peer_state_of(self._flight.path.state(t_s), self._flight.frame)
        return state if t_s > 0.0 else replace(state, vn_mps=0.0, ve_mps=0.0, vd_mps=0.0, airspeed_mps=0.0)


def fly(
    flight: Flight,
    folder: Path,
    map_path: Path,
    out: Path,
    *,
    seed: int,
    console: Console,
    on_start: Callable[[], None] | None = None,
) -> tuple[int, PeerReport]:
    """Flies ``folder`` over ``map_path`` in real time. Returns the supervisor's exit code and the peer's report.

    ``on_start`` is called when the first process has started, and again with each further one."""
    clock = FlightClock()
    peer = AutopilotPeer(seed=seed, home_amsl_m=flight.ground_amsl_m, log=out / LOG)
    landed = threading.Event()
    reports: list[PeerReport] = []

    def land() -> None:
        if not reports:
            reports.append(peer.stop())
            landed.set()

    def on_event(event: ProcessEvent) -> None:
        if event.event == "stopped":
            land()  # the processes end one after the other: messages from here on are not part of the flight
        elif event.event == "started":
            if on_start is not None:
                on_start()
        else:
            console.print(f"         {event.process} {event.event}: {event.detail}", highlight=False)

    port = peer.start(0, Course(flight), clock)
    watcher = threading.Thread(
        target=_watch, args=(peer, clock, flight.duration_s, landed, console), name="demo-progress", daemon=True
    )
    watcher.start()
    try:
        exit_code = supervisor.run(
            supervisor.RunOptions(
                source=str(folder),
                map_path=map_path,
                link=f"udpout:127.0.0.1:{port}",
                out_dir=out,
                stop_after_source=True,
                log_to=out / "terrafix.log",
            ),
            supervisor.RunCallbacks(on_event=on_event, on_epoch=clock.start),
        )
    finally:
        land()
        watcher.join()
    return exit_code, reports[0]


def _watch(
    peer: AutopilotPeer, clock: FlightClock, duration_s: float, landed: threading.Event, console: Console
) -> None:
    """Prints a status line: the time, and the autopilot's fix and position error."""
    logged_s = 0.0
    with console.status("flight: starting processes") as status:
        while not landed.wait(POLL_S):
            if not clock.runs:
                continue
            fix_type, error_m = peer.latest()
            fix = "3D fix" if fix_type >= 3 else "no fix"
            error = "" if error_m is None else f", position error {error_m:.1f} m"
            line = f"flight: {min(clock(), duration_s):.0f} of {duration_s:.0f} s; autopilot: {fix}{error}"
            status.update(line)
            if not console.is_terminal and clock() - logged_s >= LOG_INTERVAL_S:
                logged_s = clock()
                console.print(line, highlight=False, soft_wrap=True)
