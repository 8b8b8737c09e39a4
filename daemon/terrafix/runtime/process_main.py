"""Entry of every process of the daemon: the fork server (fork_server.py), and what it forks.

``python -m terrafix.runtime.process_main SOCKET SUPERVISOR_PID``. A user's mistake is one line and the exit code of its
kind, a bug is a traceback; the supervisor decides what follows."""

import faulthandler
import os
import signal
import socket
import sys
import time
from pathlib import Path

import msgspec

from terrafix.core import logs
from terrafix.core.errors import TerrafixError
from terrafix.core.frames import SharedFrameStore
from terrafix.core.node import NodeContext
from terrafix.messages import Frame
from terrafix.runtime.executor import run_process
from terrafix.runtime.fork_server import WHERE_SIGNAL, WORDS, end_with
from terrafix.runtime.run_dir import RunDir
from terrafix.runtime.run_spec import Spec, table_of
from terrafix.runtime.stop_signal import StopSignal

REQUEST_BYTES = 8192  # a name and a path
ADOPTION_S = 0.0002  # between two looks


def main(arguments: list[str]) -> int:
    descriptor, supervisor_pid = int(arguments[0]), int(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the supervisor, which stops all in order
    with socket.socket(fileno=descriptor) as asked:
        wanted = serve(asked, supervisor_pid)
    return 0 if wanted is None else run(*wanted)


def serve(asked: socket.socket, supervisor_pid: int) -> tuple[str, RunDir] | None:
    """Forks a process for each request, and returns in each of them who it is; in the fork server None, at the end."""
    while request := asked.recv(REQUEST_BYTES):
        between = os.fork()
        if between == 0:
            between = os.getpid()
            if os.fork() != 0:
                os._exit(0)  # so that the supervisor is the next of kin
            while os.getppid() == between:
                time.sleep(ADOPTION_S)
            if not end_with(supervisor_pid, signal.SIGKILL):
                os._exit(1)
            asked.send(str(os.getpid()).encode())
            name, run_dir = request.decode().split(WORDS)
            return name, RunDir(Path(run_dir))
        os.waitpid(between, 0)
    return None


def run(name: str, run_dir: RunDir) -> int:
    """The process ``name``, to its end; -> exit code."""
    Path("/proc/self/comm").write_text(name)  # for `ps` and `top`: the command line is the fork server's
    stopping = StopSignal(signal.SIGTERM)
    faulthandler.enable()
    faulthandler.register(WHERE_SIGNAL, all_threads=True)
    spec = msgspec.json.decode(run_dir.spec.read_bytes(), type=Spec)
    logs.configure(spec.config.log.level, name)
    table = table_of(spec)
    process = next(p for p in table if p.name == name)
    ctx = NodeContext(
        config=spec.config,
        frames=SharedFrameStore(run_dir.frames, writer=Frame in process.publishes),
        map_path=Path(spec.map_path) if spec.map_path else None,
        out_dir=Path(spec.out_dir),
        ground_amsl_m=spec.ground_amsl_m,
        checkpoint=run_dir.checkpoint(name),
        shelf=run_dir.shelf(name),
        epoch_ns=run_dir.epoch_ns,
    )
    try:
        run_process(name, ctx, run_dir, stopping=stopping, table=table)
    except TerrafixError as error:
        run_dir.mistake(name).write_text(str(error), encoding="utf-8")
        logs.get().error("cannot go on", reason=str(error))
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
