"""Reads the bus of a run and shows its status."""

import json
import time
from typing import Any

import typer
from rich.console import Console
from rich.live import Live

from terrafix.core.clock import now_ns
from terrafix.processes import PROCESSES
from terrafix.runtime.observer import Observer
from terrafix.runtime.run_dir import RunDir
from terrafix_tools.status.facts import facts
from terrafix_tools.status.processes import process_states
from terrafix_tools.status.screen import screen
from terrafix_tools.status.state import KINDS, Status

ONCE_S = 2.5  # of messages that one look takes: twice the interval of those at 1 Hz, and the time to connect
REFRESH_S = 0.5
POLL_MS = 50


def look(run: RunDir, seconds: float = ONCE_S) -> dict[str, Any]:
    """-> the facts after ``seconds`` of messages."""
    with Observer(run, KINDS, PROCESSES) as observer:
        status = Status(now_ns())
        _take(observer, status, seconds)
        return facts(status, process_states(run, now_ns()), now_ns())


def print_once(run: RunDir, console: Console, *, as_json: bool) -> None:
    found = look(run)
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        console.print(screen(found, _title(run)))


def watch(run: RunDir, console: Console) -> None:
    """Until the run ends or Ctrl-C."""
    with Observer(run, KINDS, PROCESSES) as observer, Live(console=console, screen=True, auto_refresh=False) as live:
        status = Status(now_ns())
        while run.spec.exists():
            _take(observer, status, REFRESH_S)
            found = facts(status, process_states(run, now_ns()), now_ns())
            live.update(screen(found, _title(run)), refresh=True)


def _take(observer: Observer, status: Status, seconds: float) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        for message in observer.receive(POLL_MS):
            status.take(now_ns(), message)


def _title(run: RunDir) -> str:
    return f"Terrafix, {run.path.name}"
