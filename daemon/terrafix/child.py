"""Entry of every process of the daemon: ``python -m terrafix.child NAME RUN_DIR SUPERVISOR_PID``.

A user's mistake is one line and the exit code of its kind, a bug is a traceback; the supervisor decides what
follows."""

import ctypes
import faulthandler
import os
import signal
import sys
import threading
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
from terrafix.processes import Process

PR_SET_PDEATHSIG = 1  # prctl(2)
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
    name, run_dir, supervisor_pid = arguments[0], RunDir(Path(arguments[1])), int(arguments[2])
    if not _die_with(supervisor_pid):
        return 1
    stopping = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopping.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the supervisor, which stops all in order
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
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    return os.getppid() == supervisor_pid


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
