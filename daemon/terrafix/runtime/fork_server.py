"""Fork server: one interpreter that has imported the common modules and forks the processes of the daemon.

Six interpreters that each import the same modules cost a second of CPU time, which delays a restart in flight. The fork
server (``serve`` in process_main.py) has no threads and no sockets except the request socket, so that a forked process
starts in a clean state. It is not the parent of the processes: the supervisor is their subreaper, observes their exit
itself, and starts another fork server if this one dies."""

import contextlib
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO

from terrafix.runtime.run_dir import RunDir

PR_SET_PDEATHSIG = 1  # prctl(2): send a signal to this process when its parent ends
PR_SET_CHILD_SUBREAPER = 36  # prctl(2): orphaned descendants become children of this process
READY_LIMIT_S = 10.0  # without an answer and without progress it counts as stuck
FORK_ATTEMPTS = 2  # the death of a killed fork server is noticed at the next request, which is then repeated
TRACEBACK_SIGNAL = signal.SIGUSR2  # the supervisor sends it to a stuck process, which then prints its tracebacks
EXIT_UNKNOWN = 256  # exit code of a process that is no child of this one; real ones are below
FIELD_SEPARATOR = "\0"  # between the fields of a request; a path cannot contain it


class ForkedProcess:
    """A process created by the fork server, with the part of the interface of subprocess.Popen that is used."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """Exit code, -N for signal N; None while the process runs."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:  # the pid is not reused before waitpid has returned its exit status
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, limit_s: float) -> int:
        """Waits for the end of the process -> exit code as in ``poll``. Raises TimeoutError after ``limit_s``."""
        descriptor = self._pidfd() if self.poll() is None else None
        if descriptor is not None:
            try:
                select.select([descriptor], [], [], limit_s)
            finally:
                os.close(descriptor)
        code = self.poll()
        if code is None:
            raise TimeoutError
        return code

    def _pidfd(self) -> int:
        return os.pidfd_open(self.pid)


class ForkServer:
    """Client of the fork server in the supervisor. The constructor starts the server; a context manager."""

    def __init__(self, output: IO[str] | None = None) -> None:
        """``output``: file for stdout and stderr of the processes; None: inherited."""
        self._output = output
        _set_child_subreaper(True)
        self._start()

    def fork(self, name: str, run_dir: RunDir) -> ForkedProcess:
        """Starts the process ``name`` as a child of this process. Raises ChildProcessError after two failures."""
        for _ in range(FORK_ATTEMPTS):
            with contextlib.suppress(OSError):  # the fork server is dead, or did not answer in time
                self._socket.send(FIELD_SEPARATOR.join((name, str(run_dir.path))).encode())
                answer = answer_of(self._socket, lambda: processor_ticks(self._popen.pid))
                if answer:
                    return ForkedProcess(int(answer))
            self._stop()
            self._start()
        raise ChildProcessError(f"{name} could not be started")

    def close(self) -> None:
        self._stop()
        _set_child_subreaper(False)

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        self._socket, server_socket = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(READY_LIMIT_S)
        with server_socket:
            environment = {k: v for k, v in os.environ.items() if k not in ("NOTIFY_SOCKET", "WATCHDOG_USEC")}
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "terrafix.runtime.process_main", str(server_socket.fileno()), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                env=environment,
                pass_fds=[server_socket.fileno()],
            )

    def _stop(self) -> None:
        self._socket.close()
        self._popen.kill()
        self._popen.wait()


def answer_of(server: socket.socket, progress: Callable[[], int]) -> bytes:
    """-> the answer of a fork server, for which this waits as long as ``progress()`` grows within each time-out of the
    socket: the imports take long on a computer with too much to do, and a new server would begin with them again.

    Raises TimeoutError without progress, OSError when the server is dead; b"": it has closed the socket."""
    reached = progress()
    while True:
        try:
            return server.recv(64)
        except TimeoutError:
            before, reached = reached, progress()
            if reached <= before:
                raise


def processor_ticks(pid: int) -> int:
    """-> processor time that a process has used, in clock ticks (utime and stime). Raises OSError."""
    fields = stat_fields(pid)
    return int(fields[11]) + int(fields[12])


def stat_fields(pid: int) -> list[str]:
    """-> fields of /proc/PID/stat after the name, which may hold any character (proc(5)). Raises OSError."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


def set_parent_death_signal(parent_pid: int, number: signal.Signals | None) -> bool:
    """The kernel sends ``number`` (None: nothing) to this process when its parent ends. False: ``parent_pid`` is not
    its parent, which means that the parent has already ended."""
    _prctl(PR_SET_PDEATHSIG, number or 0)
    return os.getppid() == parent_pid


def _prctl(option: int, value: int) -> None:
    """prctl(2). Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"prctl({option})")


def _set_child_subreaper(enabled: bool) -> None:
    _prctl(PR_SET_CHILD_SUBREAPER, int(enabled))
