"""When a process counts as stuck: by its own progress, and not because the whole computer stood still."""

from pathlib import Path
from typing import Any

import pytest

from terrafix.processes import Process
from terrafix.runtime import managed_process
from terrafix.runtime.managed_process import ManagedProcess, State
from terrafix.runtime.run_dir import RunDir

MS = 1_000_000
STUCK_AFTER_S = 1.0


class Forked:
    """A process that runs until it is killed."""

    pid = 4711

    def __init__(self) -> None:
        self.signals: list[int] = []
        self.killed = False

    def poll(self) -> int | None:
        return -9 if self.killed else None

    def send_signal(self, number: int) -> None:
        self.signals.append(number)

    def kill(self) -> None:
        self.killed = True


class Forks:
    def fork(self, _name: str, _run_dir: RunDir) -> Forked:
        return Forked()


@pytest.fixture
def link(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ManagedProcess:
    """Started and ready at 50 ms; each check at the period of the supervisor."""
    monkeypatch.setattr(managed_process, "TRACEBACK_S", 0.0)
    server: Any = Forks()
    made = ManagedProcess(Process("link", "none", (), (), 50.0, STUCK_AFTER_S), RunDir(tmp_path), server)
    assert [event.name for event in made.check(1)] == ["started"]
    made.progress.stamp(50 * MS)
    assert not list(made.check(50 * MS)) and made.state is State.RUNNING
    return made


def stuck_after_ms(link: ManagedProcess, from_ms: int) -> int:
    """Checks every 50 ms, without any progress."""
    for ms in range(from_ms, 60_000, 50):
        if "stuck" in [event.name for event in link.check(ms * MS)]:
            return ms
    raise AssertionError("never")


def test_a_process_without_progress_is_stuck_after_its_limit(link: ManagedProcess) -> None:
    assert stuck_after_ms(link, 100) == 1100


def test_a_process_is_not_stuck_because_the_computer_stood_still(link: ManagedProcess) -> None:
    assert not list(link.check(5_000 * MS)), "5 s after the check before"
    link.progress.stamp(5_020 * MS)
    assert stuck_after_ms(link, 5_050) == 6_050


def test_a_process_that_does_not_go_on_after_a_standstill_is_stuck_after_its_limit(link: ManagedProcess) -> None:
    assert not list(link.check(5_000 * MS))
    assert stuck_after_ms(link, 5_050) == 6_050


def dies(link: ManagedProcess, at_ms: int) -> list[str]:
    forked: Any = link._forked
    forked.kill()
    return [event.name for event in link.check(at_ms * MS)]


def test_a_process_that_ran_for_seconds_is_restarted_at_once_each_time(link: ManagedProcess) -> None:
    assert [dies(link, ms) for ms in (3_000, 6_000, 9_000, 12_000)] == [["died", "restarted"]] * 4


def test_a_process_that_dies_at_its_start_is_restarted_after_a_pause_since_that_start(link: ManagedProcess) -> None:
    assert dies(link, 3_000) == ["died", "restarted"]
    assert dies(link, 3_060) == ["died"]
    assert [[event.name for event in link.check(ms * MS)] for ms in (3_090, 3_100)] == [[], ["restarted"]]
