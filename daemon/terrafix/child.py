"""Entry of every process of the daemon: the nursery (nursery.py), and what it forks.

``python -m terrafix.child SOCKET SUPERVISOR_PID``. A user's mistake is one line and the exit code of its kind, a bug is
a traceback; the supervisor decides what follows."""

import faulthandler
import os
import signal
import socket
import sys
import threading
import time
from pathlib import Path

import msgspec

from terrafix import messages
from terrafix.core import logs
from terrafix.core.config import Config
from terrafix.core.errors import TerrafixError
from terrafix.core.frames import SharedFrameStore
from terrafix.core.node import NodeContext
from terrafix.core.rundir import RunDir
from terrafix.core.shell import run_process
from terrafix.messages import Frame, Message
from terrafix.nursery import WORDS, prctl
from terrafix.processes import Process

PR_SET_PDEATHSIG = 1  # prctl(2)
REQUEST_BYTES = 8192  # a name and a path
ADOPTION_S = 0.0002  # between two looks
WHERE_SIGNAL = signal.SIGUSR2  # "where are you?": the supervisor asks a stuck process for its tracebacks


class ProcessSpec(msgspec.Struct, frozen=True, kw_only=True):
    """One row of the process table, with messages by name."""

    name: str
    module: str
    hears: list[str]
    says: list[str]
    tick_hz: float
    stuck_after_s: float
    newest: list[str]


class Spec(msgspec.Struct, frozen=True, kw_only=True):
    """What the supervisor tells its processes: one file, so that all of them see the same."""

    table: list[ProcessSpec]
    config: Config
    map_path: str | None
    out_dir: str
    ground_amsl_m: float | None


def spec_of(
    table: tuple[Process, ...], config: Config, map_path: Path | None, out_dir: Path, ground_amsl_m: float | None = None
) -> Spec:
    rows = [
        ProcessSpec(
            name=p.name,
            module=p.module,
            hears=_names(p.hears),
            says=_names(p.says),
            tick_hz=p.tick_hz,
            stuck_after_s=p.stuck_after_s,
            newest=_names(p.newest),
        )
        for p in table
    ]
    package = str(map_path) if map_path else None
    return Spec(table=rows, config=config, map_path=package, out_dir=str(out_dir), ground_amsl_m=ground_amsl_m)


def table_of(spec: Spec) -> tuple[Process, ...]:
    return tuple(
        Process(r.name, r.module, _kinds(r.hears), _kinds(r.says), r.tick_hz, r.stuck_after_s, _kinds(r.newest))
        for r in spec.table
    )


def _names(kinds: tuple[type[Message], ...]) -> list[str]:
    return [kind.__name__ for kind in kinds]


def _kinds(names: list[str]) -> tuple[type[Message], ...]:
    return tuple(getattr(messages, name) for name in names)


def main(arguments: list[str]) -> int:
    descriptor, supervisor_pid = int(arguments[0]), int(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the supervisor, which stops all in order
    with socket.socket(fileno=descriptor) as asked:
        wanted = serve(asked, supervisor_pid)
    return 0 if wanted is None else run(*wanted)


def serve(asked: socket.socket, supervisor_pid: int) -> tuple[str, RunDir] | None:
    """Forks a process for each request, and returns in each of them who it is; in the nursery None, at the end."""
    while request := asked.recv(REQUEST_BYTES):
        between = os.fork()
        if between == 0:
            between = os.getpid()
            if os.fork() != 0:
                os._exit(0)  # so that the supervisor is the next of kin
            while os.getppid() == between:
                time.sleep(ADOPTION_S)
            if not _die_with(supervisor_pid):
                os._exit(1)
            asked.send(str(os.getpid()).encode())
            name, run_dir = request.decode().split(WORDS)
            return name, RunDir(Path(run_dir))
        os.waitpid(between, 0)
    return None


def run(name: str, run_dir: RunDir) -> int:
    """The process ``name``, to its end; -> exit code."""
    Path("/proc/self/comm").write_text(name)  # for `ps` and `top`: the command line is the nursery's
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    faulthandler.enable()
    faulthandler.register(WHERE_SIGNAL, all_threads=True)
    spec = msgspec.json.decode(run_dir.spec.read_bytes(), type=Spec)
    logs.configure(spec.config.log.level, name)
    table = table_of(spec)
    process = next(p for p in table if p.name == name)
    ctx = NodeContext(
        config=spec.config,
        frames=SharedFrameStore(run_dir.frames, writer=Frame in process.says),
        map_path=Path(spec.map_path) if spec.map_path else None,
        out_dir=Path(spec.out_dir),
        ground_amsl_m=spec.ground_amsl_m,
        kept=run_dir.kept(name),
        epoch_ns=run_dir.epoch_ns,
    )
    try:
        run_process(name, ctx, run_dir, stopping=stopping.is_set, table=table)
    except TerrafixError as error:
        run_dir.mistake(name).write_text(str(error), encoding="utf-8")
        logs.get().error("cannot go on", reason=str(error))
        return error.exit_code
    return 0


def _die_with(supervisor_pid: int) -> bool:
    """Asks the kernel to kill this process when its supervisor dies. False: it is dead already."""
    prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    return os.getppid() == supervisor_pid


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
