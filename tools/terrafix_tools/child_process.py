"""Programs that a command starts beside itself."""

import os
import signal
import socket
import subprocess
from contextlib import suppress
from pathlib import Path


def free_port() -> int:
    """A TCP port on loopback that nothing uses now, for a program that is started next."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def end(process: "subprocess.Popen[bytes]", limit_s: float) -> None:
    """Ends ``process`` in order with SIGTERM, and after ``limit_s`` with SIGKILL. One that has ended is left alone."""
    process.terminate()
    try:
        process.wait(limit_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def kill_tree(process: "subprocess.Popen[bytes]") -> None:
    """Kills ``process`` and its children: those of Terrafix would outlive their supervisor for some seconds."""
    pids: list[str] = []
    with suppress(OSError):
        pids = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.kill()
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(int(pid), signal.SIGKILL)
    process.wait()
