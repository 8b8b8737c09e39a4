"""Entry point of all processes of the daemon: the fork server (fork_server.py) and the processes that it forks.

``python -m terrafix.runtime.process_main SOCKET SUPERVISOR_PID``. A user error gives one line and the exit code of its
type, a bug gives a traceback; the supervisor decides on a restart."""

import faulthandler
import gc
import importlib
import os
import signal
import socket
import sys
import time
from contextlib import suppress
from pathlib import Path

import msgspec

from terrafix.core import logs
from terrafix.core.errors import TerrafixError
from terrafix.core.frames import SharedFrameStore
from terrafix.core.node import NodeContext
from terrafix.core.state_folder import state_folder
from terrafix.messages import Frame
from terrafix.runtime import systemd
from terrafix.runtime.adopted_process import AloneForTooLong, outlive_supervisor
from terrafix.runtime.core_budget import limit_cores
from terrafix.runtime.executor import run_process
from terrafix.runtime.fork_server import FIELD_SEPARATOR, TRACEBACK_SIGNAL, set_parent_death_signal
from terrafix.runtime.run_dir import RunDir
from terrafix.runtime.run_spec import Spec, is_camera, table_of
from terrafix.runtime.stop_signal import StopSignal

REQUEST_BYTES = 8192  # a name and a path
# Libraries of several processes, which start no threads when they are imported. Imported once, before the fork, they
# take 60 MB instead of 100 in all processes together. [measured: docs/decisions/028-fork-server.md]
SHARED_LIBRARIES = ("cv2", "gtsam")
REPARENT_POLL_S = 0.0002  # interval of checks whether the supervisor has become the parent


def main(arguments: list[str]) -> int:
    descriptor, supervisor_pid = int(arguments[0]), int(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C also reaches the supervisor, which stops all in order
    import_shared_libraries()
    gc.freeze()  # the collections of a forked process then do not write into pages that it shares with the others
    with socket.socket(fileno=descriptor) as requests:
        forked_as = serve(requests, supervisor_pid)
    return 0 if forked_as is None else run(*forked_as, supervisor_pid)


def import_shared_libraries() -> None:
    """One that cannot be imported ends only the processes that need it, when these import it."""
    for library in SHARED_LIBRARIES:
        with suppress(ImportError):
            importlib.import_module(library)


def serve(requests: socket.socket, supervisor_pid: int) -> tuple[str, RunDir] | None:
    """Forks a process for each request. Returns its name and run folder in each forked process, and None in the fork
    server when the socket is closed."""
    while request := requests.recv(REQUEST_BYTES):
        intermediate_pid = os.fork()
        if intermediate_pid == 0:
            intermediate_pid = os.getpid()
            if os.fork() != 0:
                os._exit(0)  # the grandchild is orphaned, and the supervisor as subreaper becomes its parent
            while os.getppid() == intermediate_pid:
                time.sleep(REPARENT_POLL_S)
            if not set_parent_death_signal(supervisor_pid, signal.SIGKILL):
                os._exit(1)
            requests.send(str(os.getpid()).encode())
            name, run_dir = request.decode().split(FIELD_SEPARATOR)
            return name, RunDir(Path(run_dir))
        os.waitpid(intermediate_pid, 0)
    return None


def run(name: str, run_dir: RunDir, supervisor_pid: int) -> int:
    """Runs the process ``name`` to its end -> exit code."""
    Path("/proc/self/comm").write_text(name)  # for `ps` and `top`: the command line is that of the fork server
    stop_signal = StopSignal(signal.SIGTERM, ends_start=True)
    alone = AloneForTooLong(run_dir, supervisor_pid)
    faulthandler.enable()
    faulthandler.register(TRACEBACK_SIGNAL, all_threads=True)
    spec = msgspec.json.decode(run_dir.spec.read_bytes(), type=Spec)
    logs.configure(spec.config.log.level, name, systemd.log_stream())
    if is_camera(spec.config.source.path):  # a run that the next supervisor resumes
        outlive_supervisor(run_dir, name, supervisor_pid)
    limit_cores(spec.config.runtime.cores)  # before the node and its libraries are imported
    table = table_of(spec)
    process = next(p for p in table if p.name == name)
    os.nice(process.nice)
    ctx = NodeContext(
        config=spec.config,
        frames=SharedFrameStore(run_dir.frames, writer=Frame in process.publishes),
        map_path=Path(spec.map_path) if spec.map_path else None,
        out_dir=Path(spec.out_dir),
        ground_amsl_m=spec.ground_amsl_m,
        checkpoint=run_dir.checkpoint(name),
        state_dir=state_folder(),
        cache_dir=run_dir.cache_dir(name),
        epoch_ns=run_dir.epoch_ns,
    )
    try:
        run_process(name, ctx, run_dir, stopping=lambda: stop_signal() or alone(), table=table)
    except TerrafixError as error:
        run_dir.user_error(name).write_text(str(error), encoding="utf-8")
        logs.get().error("cannot continue", reason=str(error), todo="correct what the reason names, and start again")
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
