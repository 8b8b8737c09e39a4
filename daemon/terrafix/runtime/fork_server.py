"""Where the processes come from: one interpreter that has imported what all of them need, and forks.

Six interpreters that import the same cost a second of a processor, when a flight waits for all of them to be there
again. The fork server (``serve`` in process_main.py) has neither threads nor sockets but the one on which it is asked:
what it forks is as good as a program that was just started. It is the parent of nobody: the supervisor adopts the
processes, sees their end itself, and starts another fork server should this one die."""

import contextlib
import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
from typing import IO

from terrafix.runtime.run_dir import RunDir

PR_SET_PDEATHSIG = 1  # prctl(2): a signal for us when our parent ends
PR_SET_CHILD_SUBREAPER = 36  # a process whose parent ended becomes ours
READY_LIMIT_S = 10.0  # imports, on a computer that is very busy
TRIES = 2  # a fork server that was killed is found dead when the next process is wanted
WHERE_SIGNAL = signal.SIGUSR2  # "where are you?": the supervisor asks a stuck process for its tracebacks
WORDS = "\0"  # between the words of a request: a path has none


class Forked:
    """A process of the fork server's, with what is used of subprocess.Popen."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._code: int | None = None

    def poll(self) -> int | None:
        """Its exit code, -N for signal N; None while it lives."""
        if self._code is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:  # its number is not another's before we have seen its end
            os.kill(self.pid, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, limit_s: float) -> int:
        """Raises TimeoutError."""
        descriptor = os.pidfd_open(self.pid) if self.poll() is None else None
        if descriptor is not None:
            try:
                select.select([descriptor], [], [], limit_s)
            finally:
                os.close(descriptor)
        code = self.poll()
        if code is None:
            raise TimeoutError
        return code


class ForkServer:
    """The supervisor's view. It is started at once and is ready when somebody is wanted; a context manager."""

    def __init__(self, output: IO[str] | None = None) -> None:
        """``output``: where stdout and stderr of the processes go; None: where ours go."""
        self._output = output
        _adopt(True)
        self._start()

    def fork(self, name: str, run_dir: RunDir) -> Forked:
        """The process ``name`` begins to run, as a child of this process. Raises ChildProcessError: twice in vain."""
        for _ in range(TRIES):
            with contextlib.suppress(OSError):  # it is dead, or was too long in coming
                self._socket.send(WORDS.join((name, str(run_dir.path))).encode())
                answer = self._socket.recv(64)
                if answer:
                    return Forked(int(answer))
            self._stop()
            self._start()
        raise ChildProcessError(f"{name} could not be started")

    def close(self) -> None:
        self._stop()
        _adopt(False)

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(READY_LIMIT_S)
        with theirs:
            environment = {k: v for k, v in os.environ.items() if k not in ("NOTIFY_SOCKET", "WATCHDOG_USEC")}
            self._popen = subprocess.Popen(
                [sys.executable, "-m", "terrafix.runtime.process_main", str(theirs.fileno()), str(os.getpid())],
                stdin=subprocess.DEVNULL,
                stdout=self._output,
                stderr=self._output,
                env=environment,
                pass_fds=[theirs.fileno()],
            )

    def _stop(self) -> None:
        self._socket.close()
        self._popen.kill()
        self._popen.wait()


def end_with(parent_pid: int, number: signal.Signals) -> bool:
    """Asks the kernel to send this process that signal when its parent has ended. False: it has already."""
    _prctl(PR_SET_PDEATHSIG, number)
    return os.getppid() == parent_pid


def _prctl(option: int, value: int) -> None:
    """prctl(2). Raises OSError."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(option, value, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), f"prctl({option})")


def _adopt(wanted: bool) -> None:
    _prctl(PR_SET_CHILD_SUBREAPER, int(wanted))
