"""Processes that survive their supervisor, and the supervisor that takes them over.

A killed supervisor need not cost a fix: the processes fly on without it, and the next supervisor, which takes over the
run folder, monitors those that are alive instead of starting them. If none comes, they end by themselves in order."""

import os
import select
import signal
from collections.abc import Callable
from pathlib import Path

from terrafix.core import logs
from terrafix.core.clock import now_ns
from terrafix.runtime.fork_server import EXIT_UNKNOWN, ForkedProcess, set_parent_death_signal, stat_fields
from terrafix.runtime.run_dir import RunDir, write_atomic

# A process that has no supervisor for so long ends. [spec: WatchdogSec of the unit; a supervisor is there again 1 s
# after its death, and 10 s after it on a computer with ten times the load]
WITHOUT_SUPERVISOR_NS = 10_000_000_000
CHECK_PERIOD_NS = 500_000_000  # [spec: a twentieth of the limit]
START_TIME_FIELD = 19  # of ``stat_fields``: in clock ticks since the boot


class AdoptedProcess(ForkedProcess):
    """A process that another supervisor has started. It is no child of this process, so its exit code is unknown."""

    def __init__(self, pid: int, descriptor: int) -> None:
        """``descriptor``: its pidfd, which this object closes when it has ended."""
        super().__init__(pid)
        self._descriptor = descriptor

    def poll(self) -> int | None:
        """EXIT_UNKNOWN; None while the process runs."""
        if self._code is None and select.select([self._descriptor], [], [], 0)[0]:
            self._code = EXIT_UNKNOWN
            os.close(self._descriptor)
        return self._code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            signal.pidfd_send_signal(self._descriptor, number)

    def _pidfd(self) -> int:
        return os.dup(self._descriptor)


def adopt(pid_file: Path) -> AdoptedProcess | None:
    """The process that has written ``pid_file`` (``outlive_supervisor``); None: there is none that is alive."""
    try:
        pid, start_time = (int(word) for word in pid_file.read_text().split())
        descriptor = os.pidfd_open(pid)
    except (OSError, ValueError):
        return None
    process = AdoptedProcess(pid, descriptor)
    if process.poll() is None:
        if _start_time(pid) == start_time:
            return process
        os.close(descriptor)  # the pid was given to another program
    return None


def outlive_supervisor(run_dir: RunDir, name: str, supervisor_pid: int) -> None:
    """Called by the process ``name``, which so far ends with its supervisor: from now on another one can adopt it.

    When shared memory is full it goes on ending with its supervisor: none could find it."""
    try:
        write_atomic(run_dir.pid(name), f"{os.getpid()} {_start_time(os.getpid())}".encode())
    except OSError as error:
        logs.get().warning("cannot outlive the supervisor", why=str(error.strerror))
        return
    set_parent_death_signal(supervisor_pid, None)


class AloneForTooLong:
    """Calling the object returns whether this process has had no supervisor for WITHOUT_SUPERVISOR_NS."""

    def __init__(self, run_dir: RunDir, supervisor_pid: int, clock: Callable[[], int] = now_ns) -> None:
        self._run_dir = run_dir
        self._supervisor_pid = supervisor_pid
        self._clock = clock
        self._next_ns = 0  # time of the next check
        self._alone_since_ns: int | None = None
        self._ends = False

    def __call__(self) -> bool:
        now = self._clock()
        if self._ends or now < self._next_ns:
            return self._ends
        self._next_ns = now + CHECK_PERIOD_NS
        # The parent of an adopted process is init; the lock of the folder is the one of any supervisor.
        if os.getppid() == self._supervisor_pid or self._run_dir.is_supervised:
            self._alone_since_ns = None
        elif self._alone_since_ns is None:
            self._alone_since_ns = now
            logs.get().warning("no supervisor", limit_s=WITHOUT_SUPERVISOR_NS / 1e9)
        elif now - self._alone_since_ns > WITHOUT_SUPERVISOR_NS:
            self._ends = True
            logs.get().error("no supervisor for too long, ends", todo="start Terrafix again")
        return self._ends


def _start_time(pid: int) -> int | None:
    """None: there is no such process."""
    try:
        return int(stat_fields(pid)[START_TIME_FIELD])
    except (OSError, IndexError):
        return None
