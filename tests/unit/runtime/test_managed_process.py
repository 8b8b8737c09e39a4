"""When a process counts as stuck: by its own progress, and not because the whole computer stood still."""

import os
import signal
import subprocess
import sys
import time
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
    monkeypatch.setattr(managed_process, "waited_for_processor_ns", lambda _pid: 0)
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


def test_what_a_process_waits_for_a_processor_is_no_time_without_progress(
    link: ManagedProcess, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited_ms = {"now": 70_000}  # before the progress: of no concern
    monkeypatch.setattr(managed_process, "waited_for_processor_ns", lambda pid: waited_ms["now"] * MS * (pid == 4711))
    link.progress.stamp(100 * MS)
    assert not list(link.check(100 * MS))
    for ms in range(150, 3_150, 50):
        waited_ms["now"] += 40  # of 50
        assert not list(link.check(ms * MS)), "2.4 of 3 s it could not run"
    assert stuck_after_ms(link, 3_150) == 100 + 1_000 + 2_400 + 50, "from the 3550th ms on it is more than a second"


def test_a_stopped_process_does_not_wait_for_a_processor() -> None:
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(20.0)"]) as process:
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED)
        before_ns = managed_process.waited_for_processor_ns(process.pid)
        time.sleep(0.1)
        after_ns = managed_process.waited_for_processor_ns(process.pid)
        process.kill()
    assert after_ns == before_ns
    assert managed_process.waited_for_processor_ns(process.pid) == 0, "it has ended"


def test_the_wait_for_a_processor_is_the_run_delay_of_the_kernel(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "schedstat").write_text("4711 815 3\n")
    monkeypatch.setattr(managed_process, "Path", lambda _path: tmp_path / "schedstat")
    assert managed_process.waited_for_processor_ns(1) == 815
