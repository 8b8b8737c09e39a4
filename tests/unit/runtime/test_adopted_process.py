"""Processes that outlive their supervisor: which are adopted, and when one that nobody adopts ends."""

import fcntl
import os
import signal
from pathlib import Path

import pytest

from terrafix.runtime.adopted_process import (
    CHECK_PERIOD_NS,
    WITHOUT_SUPERVISOR_NS,
    AloneForTooLong,
    _start_time,
    adopt,
)
from terrafix.runtime.fork_server import EXIT_UNKNOWN
from terrafix.runtime.managed_process import describe
from terrafix.runtime.run_dir import OwnedRunDir, RunDir

S = 1_000_000_000


def test_only_the_living_process_that_wrote_the_file_is_adopted(tmp_path: Path) -> None:
    file = tmp_path / "link.pid"
    assert adopt(file) is None
    pid = os.posix_spawn("/bin/sleep", ["sleep", "30"], os.environ)
    started = _start_time(pid)
    assert started is not None
    for text in ("", "no number", f"{pid}", f"{pid} {started + 1}", f"{pid} None"):
        file.write_text(text)
        assert adopt(file) is None, text
    file.write_text(f"{pid} {started}")
    adopted, second = adopt(file), adopt(file)
    assert adopted is not None and second is not None and adopted.pid == pid
    assert adopted.poll() is None
    with pytest.raises(TimeoutError):
        adopted.wait(0.05)
    adopted.terminate()
    assert adopted.wait(5.0) == EXIT_UNKNOWN
    assert adopt(file) is None, "it has ended, and nobody has waited for it yet"
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGTERM
    second.kill()  # the pid may be reused by now
    assert second.poll() == EXIT_UNKNOWN
    assert describe(EXIT_UNKNOWN) == "exit code unknown: started by the supervisor before"


def test_a_process_ends_when_it_had_no_supervisor_for_the_limit_in_one_piece(tmp_path: Path) -> None:
    now = 0
    owned = OwnedRunDir(tmp_path, b"spec")
    folder = RunDir(owned.run_dir.path)
    ends = AloneForTooLong(folder, supervisor_pid=-1, clock=lambda: now)  # adopted: the parent is init
    owned.keep_for_successor = True

    def after(step_ns: int) -> bool:
        nonlocal now
        now += step_ns
        return ends()

    assert not after(100 * S), "its supervisor holds the lock"
    owned.remove()
    assert not after(S)
    assert not after(WITHOUT_SUPERVISOR_NS), "one period is left"
    taken = os.open(folder.path / "lock", os.O_RDWR)
    fcntl.flock(taken, fcntl.LOCK_EX)
    assert not after(S), "another supervisor has taken over"
    os.close(taken)
    assert not after(S)
    assert not after(WITHOUT_SUPERVISOR_NS)
    assert after(CHECK_PERIOD_NS)


def test_a_process_whose_parent_is_its_supervisor_does_not_end(tmp_path: Path) -> None:
    now = 0
    ends = AloneForTooLong(RunDir(tmp_path), supervisor_pid=os.getppid(), clock=lambda: now)
    assert not ends()
    now = 2 * WITHOUT_SUPERVISOR_NS
    assert not ends()
