"""One supervised process: started, watched by its progress, restarted within limits, stopped."""

import signal
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum

from terrafix.core.errors import TerrafixError
from terrafix.processes import Process
from terrafix.runtime.fork_server import WHERE_SIGNAL, Forked, ForkServer
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

RESTART_LIMIT = 5  # deaths in the window; more is not bad luck but a fault that a restart does not cure
RESTART_WINDOW_NS = 60_000_000_000
BACKOFF_NS = (0, 100_000_000, 300_000_000, 1_000_000_000)  # before the 1st, 2nd, ... restart in the window
FIRST_START_LIMIT_NS = 300_000_000_000  # imports, and engines that are built when the models are new
START_LIMIT_NS = 60_000_000_000  # a process that was ready before has nothing left to build
STOP_LIMIT_S = 5.0  # SIGTERM to SIGKILL
KILL_LIMIT_S = 1.0  # SIGKILL to the end, unless a driver holds the process in the kernel
TRACEBACK_S = 0.2  # for a stuck process to say where it is
USER_MISTAKES = frozenset(kind.exit_code for kind in TerrafixError.__subclasses__())


@dataclass(frozen=True)
class Event:
    """``name`` as in messages.ProcessEvent."""

    name: str
    detail: str = ""


@dataclass(frozen=True)
class Mistake:
    """Why a process could not even start, when that is something the user can mend."""

    exit_code: int
    text: str


class State(Enum):
    WAITING = "waiting"  # to be started, now or after a pause
    STARTING = "starting"  # no progress stamp yet
    RUNNING = "running"
    FINISHED = "finished"  # ended by itself with 0
    GAVE_UP = "gave up"


class RestartWindow:
    """How long to wait before the next restart, or None: it has died too often."""

    def __init__(self) -> None:
        self._deaths_ns: deque[int] = deque()

    def died(self, now_ns: int) -> int | None:
        while self._deaths_ns and now_ns - self._deaths_ns[0] > RESTART_WINDOW_NS:
            self._deaths_ns.popleft()
        self._deaths_ns.append(now_ns)
        deaths = len(self._deaths_ns)
        return None if deaths > RESTART_LIMIT else BACKOFF_NS[min(deaths, len(BACKOFF_NS)) - 1]


class ManagedProcess:
    def __init__(self, process: Process, run_dir: RunDir, fork_server: ForkServer) -> None:
        self.process = process
        self.state = State.WAITING
        self.mistake: Mistake | None = None
        self.progress = Progress.create(run_dir.progress(process.name))
        self._run_dir = run_dir
        self._nursery = fork_server
        self._forked: Forked | None = None
        self._start_at_ns = 0
        self._started_ns = 0
        self._lives = 0
        self._was_ready = False
        self._killed = False  # by us, for being stuck; its end is still to come
        self._window = RestartWindow()

    @property
    def pid(self) -> int | None:
        return self._forked.pid if self._forked else None

    @property
    def settled(self) -> bool:
        """Nobody needs to wait for it: it is ready, or it never will be."""
        return self.state in (State.RUNNING, State.FINISHED, State.GAVE_UP)

    def check(self, now_ns: int) -> Iterator[Event]:
        """Looks after the process once; yields what happened."""
        if self.state is State.WAITING:
            if now_ns >= self._start_at_ns:
                yield self._start(now_ns)
        elif self._forked is not None:
            code = self._forked.poll()
            if code is not None:
                yield from self._ended(code, now_ns)
            elif not self._killed and self._is_stuck(now_ns):
                age_s = (now_ns - self._progress_ns()) / 1e9
                self._show_traceback_and_kill()
                yield Event("stuck", f"no progress for {age_s:.1f} s, killed")
            elif self.state is State.STARTING and self.progress.stamp_ns:
                self.state, self._was_ready = State.RUNNING, True

    def stop(self) -> Event | None:
        """SIGTERM, and SIGKILL if that does not help. None: it did not run."""
        if self._forked is None:
            return None
        self._forked.terminate()
        try:
            detail = describe(self._forked.wait(STOP_LIMIT_S))
        except TimeoutError:
            self._show_traceback_and_kill()
            detail = f"killed: still there {STOP_LIMIT_S:.0f} s after SIGTERM"
            try:
                self._forked.wait(KILL_LIMIT_S)
            except TimeoutError:
                detail += "; it hangs in the kernel"
        self._forked = None
        return Event("stopped", detail)

    def _start(self, now_ns: int) -> Event:
        self.progress.reset()
        self._forked = self._nursery.fork(self.process.name, self._run_dir)
        self.state = State.STARTING
        self._killed = False
        self._started_ns = now_ns
        self._lives += 1
        return Event("started" if self._lives == 1 else "restarted", f"pid {self._forked.pid}")

    def _ended(self, code: int, now_ns: int) -> Iterator[Event]:
        self._forked = None
        if code == 0:
            self.state = State.FINISHED
            yield Event("stopped", "finished by itself")
            return
        if not self._killed:
            yield Event("died", describe(code))
        if code in USER_MISTAKES and not self._was_ready:
            file = self._run_dir.mistake(self.process.name)
            self.mistake = Mistake(code, file.read_text(encoding="utf-8") if file.exists() else "no reason given")
            self.state = State.GAVE_UP
            self._run_dir.gave_up(self.process.name).touch()
            yield Event("gave_up", f"cannot start: {self.mistake.text}")
            return
        pause_ns = self._window.died(now_ns)
        if pause_ns is None:
            self.state = State.GAVE_UP
            self._run_dir.gave_up(self.process.name).touch()
            yield Event("gave_up", f"died more than {RESTART_LIMIT} times in {RESTART_WINDOW_NS // 10**9} s")
        else:
            self.state, self._start_at_ns = State.WAITING, now_ns + pause_ns
            if pause_ns == 0:
                yield self._start(now_ns)

    def _progress_ns(self) -> int:
        return self.progress.stamp_ns or self._started_ns

    def _is_stuck(self, now_ns: int) -> bool:
        limit_ns = self.process.stuck_after_s * 1e9
        if self.state is State.STARTING:
            limit_ns = START_LIMIT_NS if self._was_ready else FIRST_START_LIMIT_NS
        return now_ns - self._progress_ns() > limit_ns

    def _show_traceback_and_kill(self) -> None:
        assert self._forked is not None
        self._forked.send_signal(WHERE_SIGNAL)
        threading.Event().wait(TRACEBACK_S)
        self._forked.kill()
        self._killed = True


def describe(code: int) -> str:
    """-9 -> 'killed by SIGKILL', 1 -> 'exit code 1'."""
    if code >= 0:
        return f"exit code {code}"
    try:
        return f"killed by {signal.Signals(-code).name}"
    except ValueError:
        return f"killed by signal {-code}"
