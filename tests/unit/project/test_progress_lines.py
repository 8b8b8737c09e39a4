"""Progress of commands whose output is piped: a line now and then, nothing of bars."""

import io
import time

import pytest
from rich.console import Console

from terrafix_tools import progress
from terrafix_tools.progress import LineProgress, waiting


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "LINE_INTERVAL_S", 0.01)


def seen(stream: io.StringIO, text: str) -> bool:
    until_s = time.monotonic() + 5.0
    while time.monotonic() < until_s and text not in stream.getvalue():
        time.sleep(0.005)
    return text in stream.getvalue()


def test_a_step_that_takes_long_says_what_is_done_so_far() -> None:
    stream = io.StringIO()
    with LineProgress("{task.description}", console=Console(file=stream)) as bars:
        task = bars.add_task("flights", total=12)
        bars.advance(task, 3)
        assert seen(stream, "flights: 3 of 12\n")
    assert "\x1b" not in stream.getvalue()


def test_a_wait_without_steps_repeats_what_it_waits_for() -> None:
    stream = io.StringIO()
    with waiting(Console(file=stream), "writing the map"):
        assert seen(stream, "writing the map\nwriting the map\n")


def test_what_is_not_shown_prints_nothing_and_a_terminal_has_bars_alone() -> None:
    quiet, terminal = io.StringIO(), io.StringIO()
    with LineProgress(console=Console(file=quiet), shown=False) as bars:
        bars.add_task("a", total=1)
        time.sleep(0.03)
    with LineProgress("{task.description}", console=Console(file=terminal, force_terminal=True)) as bars:
        bars.add_task("a", total=7)
        time.sleep(0.03)
    assert quiet.getvalue() == "" and "a: 0 of 7" not in terminal.getvalue()
