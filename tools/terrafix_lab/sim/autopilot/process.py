"""Runs the autopilot peer in its own process: ``python -m terrafix_lab.sim.autopilot.process COURSE.csv``."""

import signal
import time
from pathlib import Path
from typing import Annotated

import typer

from terrafix.runtime.stop_signal import StopSignal
from terrafix_lab.sim.autopilot.course import read_course
from terrafix_lab.sim.autopilot.peer import AutopilotPeer
from terrafix_lab.standalone import run_standalone

POLL_S = 0.05  # polling interval of the stop signal; a signal ends the sleep at once


def fly_course(
    course: Annotated[Path, typer.Argument(help="Course: CSV in the format of course.py.")],
    port: Annotated[int, typer.Option(help="UDP port on 127.0.0.1; 0: a free one.")] = 14550,
    out: Annotated[Path, typer.Option(help="Report to write at the end.")] = Path("peer.json"),
    start_ns: Annotated[int, typer.Option(help="Monotonic time of second 0 of the course; default: now.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of the sensor noise.")] = 0,
    aligned: Annotated[bool, typer.Option(help="Start in the air with a known position.")] = True,
) -> None:
    """Fly until SIGTERM or SIGINT, then write the report."""
    stopping = StopSignal(signal.SIGTERM, signal.SIGINT)
    zero_ns = start_ns or time.monotonic_ns()
    peer = AutopilotPeer(seed=seed, aligned=aligned)
    used = peer.start(port, read_course(course), lambda: (time.monotonic_ns() - zero_ns) * 1e-9)
    typer.echo(f"autopilot peer on udp 127.0.0.1:{used}")
    while not stopping():
        time.sleep(POLL_S)
    peer.stop().write(out)


if __name__ == "__main__":
    run_standalone("terrafix peer", fly_course)
