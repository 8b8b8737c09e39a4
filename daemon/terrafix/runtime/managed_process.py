"""One supervised process: start, monitoring of its progress, restart within limits, stop."""

import signal
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

from terrafix.core.clock import now_ns
from terrafix.core.errors import ERROR_OF_EXIT_CODE
from terrafix.processes import Process
from terrafix.runtime.adopted_process import adopt
from terrafix.runtime.fork_server import EXIT_UNKNOWN, TRACEBACK_SIGNAL, ForkedProcess, ForkServer
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

RESTART_LIMIT = 5  # deaths within the window; more indicate a fault that a restart does not clear
RESTART_WINDOW_NS = 60_000_000_000
# From the start before to the 1st, 2nd, ... restart in the window: a process that ran longer is restarted at once.
BACKOFF_NS = (0, 100_000_000, 300_000_000, 1_000_000_000)
FIRST_START_LIMIT_NS = 300_000_000_000  # imports, and engines that are built when the models are new
START_LIMIT_NS = 60_000_000_000  # a process that was ready before has already built its engines
STOP_LIMIT_S = 5.0  # from SIGTERM to SIGKILL
KILL_LIMIT_S = 1.0  # from SIGKILL to the exit; it takes longer if a driver blocks the process in the kernel
# between two checks; one takes some TRACEBACK_S at most [spec: ten periods of the supervisor]
CHECK_PAUSE_NS = 500_000_000
TRACEBACK_S = 0.2  # for a stuck process to print its tracebacks


@dataclass(frozen=True)
class Event:
    """``name``: as ``event`` in messages.ProcessEvent."""

    name: str
    detail: str = ""


@dataclass(frozen=True)
class UserError:
    """Why a process could not start, if it is an error that the user can correct."""

    exit_code: int
    text: str


class State(Enum):
    WAITING = "waiting"  # to be started, at once or after a pause
    STARTING = "starting"  # no progress stamp yet
    RUNNING = "running"
    FINISHED = "finished"  # ended by itself with exit code 0
    GAVE_UP = "gave up"


class ProcessorWait:
    """Time that a process waits for a processor while it makes no progress: a computer with too much to do is no reason
    to restart the process, which would cost even more."""

    def __init__(self) -> None:
        self._since_ns = -1
        self._before_ns = 0

    def since(self, progress_ns: int, pid: int) -> int:
        """Time [ns] that its main thread waited since ``progress_ns``, as far as calls with this value saw it."""
        waited_ns = waited_for_processor_ns(pid)
        if progress_ns != self._since_ns:
            self._since_ns, self._before_ns = progress_ns, waited_ns
        return max(0, waited_ns - self._before_ns)


def waited_for_processor_ns(pid: int) -> int:
    """Time [ns] that the main thread was ready to run and did not (run delay of /proc/PID/schedstat, Linux'
    sched-stats.rst); 0 where the kernel does not count it or the process has ended."""
    try:
        return int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0


class RestartWindow:
    """Limits restarts by the number of deaths within RESTART_WINDOW_NS."""

    def __init__(self) -> None:
        self._deaths_ns: deque[int] = deque()

    def record_death(self, now_ns: int) -> int | None:
        """-> least time [ns] between the last start and the next one; None: the process has died too often."""
        while self._deaths_ns and now_ns - self._deaths_ns[0] > RESTART_WINDOW_NS:
            self._deaths_ns.popleft()
        self._deaths_ns.append(now_ns)
        deaths = len(self._deaths_ns)
        return None if deaths > RESTART_LIMIT else BACKOFF_NS[min(deaths, len(BACKOFF_NS)) - 1]


class ManagedProcess:
    def __init__(self, process: Process, run_dir: RunDir, fork_server: ForkServer) -> None:
        self.process = process
        self.state = State.WAITING
        self.user_error: UserError | None = None
        self._run_dir = run_dir
        self._fork_server = fork_server
        self._forked: ForkedProcess | None = adopt(run_dir.pid(process.name))
        self._adopted = self._forked is not None  # and not reported yet
        self._start_at_ns = 0
        self._started_ns = now_ns()
        self._checked_ns = 0  # time of the last check
        self._resumed_ns = 0  # time at which checks went on after a pause
        self._starts = int(self._adopted)
        self._was_ready = False
        progress = run_dir.progress(process.name)
        if self._adopted:
            self.progress, self.state = Progress(progress), State.STARTING
        else:
            self.progress = Progress.create(progress)
        self._killed = False  # killed by the supervisor because it was stuck; its exit is still pending
        self._window = RestartWindow()
        self._processor_wait = ProcessorWait()

    @property
    def pid(self) -> int | None:
        return self._forked.pid if self._forked else None

    @property
    def settled(self) -> bool:
        """Whether it is ready or never will be, so that readiness of the daemon need not wait for it."""
        return self.state in (State.RUNNING, State.FINISHED, State.GAVE_UP)

    def check(self, now_ns: int) -> Iterator[Event]:
        """One check of the process: starts, restarts or kills it if necessary. Yields the resulting events, at first
        that it was adopted."""
        if self._checked_ns and now_ns - self._checked_ns > CHECK_PAUSE_NS:
            self._resumed_ns = now_ns
        self._checked_ns = now_ns
        if self._adopted and self._forked is not None:
            self._adopted = False
            yield Event("adopted", f"pid {self._forked.pid}")
        if self.state is State.WAITING:
            if now_ns >= self._start_at_ns:
                yield self._start(now_ns)
        elif self._forked is not None:
            code = self._forked.poll()
            if code is not None:
                yield from self._ended(code, now_ns)
            elif not self._killed and self._is_stuck(self._forked.pid, now_ns):
                age_s = (now_ns - self._progress_ns()) / 1e9
                self._show_traceback_and_kill()
                yield Event("stuck", f"no progress for {age_s:.1f} s, killed")
            elif self.state is State.STARTING and self.progress.stamp_ns:
                self.state, self._was_ready = State.RUNNING, True

    def stop(self) -> Event | None:
        """SIGTERM, then SIGKILL after STOP_LIMIT_S. None: the process was not running."""
        if self._forked is None:
            return None
        self._forked.terminate()
        try:
            detail = describe(self._forked.wait(STOP_LIMIT_S))
        except TimeoutError:
            self._show_traceback_and_kill()
            detail = f"killed: still running {STOP_LIMIT_S:.0f} s after SIGTERM"
            try:
                self._forked.wait(KILL_LIMIT_S)
            except TimeoutError:
                detail += "; it is blocked in the kernel"
        self._forked = None
        return Event("stopped", detail)

    def _start(self, now_ns: int) -> Event:
        self.progress.reset()
        self._forked = self._fork_server.fork(self.process.name, self._run_dir)
        self.state = State.STARTING
        self._killed = False
        self._started_ns = now_ns
        self._starts += 1
        return Event("started" if self._starts == 1 else "restarted", f"pid {self._forked.pid}")

    def _ended(self, code: int, now_ns: int) -> Iterator[Event]:
        self._forked = None
        if code == 0:
            self.state = State.FINISHED
            yield Event("stopped", "finished by itself")
            return
        if not self._killed:
            yield Event("died", describe(code))
        if code in ERROR_OF_EXIT_CODE and not self._was_ready:
            file = self._run_dir.user_error(self.process.name)
            self.user_error = UserError(code, file.read_text(encoding="utf-8") if file.exists() else "no reason given")
            self.state = State.GAVE_UP
            self._run_dir.gave_up(self.process.name).touch()
            yield Event("gave_up", f"cannot start: {self.user_error.text}")
            return
        pause_ns = self._window.record_death(now_ns)
        if pause_ns is None:
            self.state = State.GAVE_UP
            self._run_dir.gave_up(self.process.name).touch()
            yield Event("gave_up", f"died more than {RESTART_LIMIT} times in {RESTART_WINDOW_NS // 10**9} s")
        else:
            self.state, self._start_at_ns = State.WAITING, self._started_ns + pause_ns
            if self._start_at_ns <= now_ns:
                yield self._start(now_ns)

    def _progress_ns(self) -> int:
        """Time since which it makes no progress. If this computer stood still, no process could make any."""
        return max(self.progress.stamp_ns or self._started_ns, self._resumed_ns)

    def _is_stuck(self, pid: int, now_ns: int) -> bool:
        limit_ns = self.process.stuck_after_s * 1e9
        if self.state is State.STARTING:
            limit_ns = START_LIMIT_NS if self._was_ready else FIRST_START_LIMIT_NS
        progress_ns = self._progress_ns()
        return now_ns - progress_ns - self._processor_wait.since(progress_ns, pid) > limit_ns

    def _show_traceback_and_kill(self) -> None:
        assert self._forked is not None
        self._forked.send_signal(TRACEBACK_SIGNAL)
        threading.Event().wait(TRACEBACK_S)
        self._forked.kill()
        self._killed = True


def describe(code: int) -> str:
    """Exit code as text: -9 -> 'killed by SIGKILL', 1 -> 'exit code 1'."""
    if code == EXIT_UNKNOWN:
        return "exit code unknown: started by the supervisor before"
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
