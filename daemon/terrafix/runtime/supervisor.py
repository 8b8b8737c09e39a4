"""The supervisor: starts the processes in table order, monitors their progress, restarts them, stops them in reverse.

Its loop does little, so that it is unlikely to fail; all flight
functions are in the processes. Only the failure of the link ends the unit. When another process is given up, the
others continue, and the state is reported."""

import contextlib
import errno
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import zmq

from terrafix.core import config as configuration
from terrafix.core import logs
from terrafix.core.clock import Ticker, now_ns
from terrafix.core.config import Config, without_passwords
from terrafix.core.errors import MapError, OutputError
from terrafix.core.log_lines import MessageLog
from terrafix.messages import LogLine, ProcessEvent, SourceEnded
from terrafix.processes import PROCESSES, SMOOTHER, SUPERVISOR, Process
from terrafix.runtime import systemd
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.fork_server import ForkServer
from terrafix.runtime.managed_process import Event, ManagedProcess, State
from terrafix.runtime.run_dir import OwnedRunDir, RunDir, recently_killed_runs
from terrafix.runtime.run_spec import Spec, is_camera, spec_of
from terrafix.runtime.stop_signal import StopSignal

LINK_GAVE_UP = 1  # exit code
REQUIRED_PROCESS = "link"  # without it nothing is sent to the autopilot: systemd then restarts the whole unit
LOOP_MS = 50  # the death of a process is detected within this time
QUIET_NS = 1_000_000_000  # after the end of the source all work is done when all were idle for this long ...
DRAIN_LIMIT_NS = 60_000_000_000  # ... or when this long has passed since
FRESH_NS = 500_000_000  # a process with an older progress stamp is still working on a message
NOTIFY_HZ = 2.0  # rate of WATCHDOG=1; WatchdogSec of the unit is several times the period
SQLITE_MAGIC = b"SQLite format 3\0"  # a map package is a GeoPackage, and that is SQLite

# The disk of the record is full (space or inodes), over its quota, read-only or broken.
DISK_FAILURES = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO)


@dataclass(frozen=True)
class RunOptions:
    """The options of `terrafix run`. ``source``, ``map_path`` (a map package), ``link``, ``start`` ("LAT,LON") override
    the configuration when not empty."""

    out_dir: Path
    configs: Sequence[Path] = ()
    source: str = ""
    map_path: Path | None = None
    link: str = ""
    start: str = ""
    ground_amsl_m: float | None = None  # of the map at the start, for a source without one
    stop_after_source: bool = False  # else it runs until a signal
    log_to: Path | None = None  # file for all logs and tracebacks instead of stdout and stderr

    def config(self) -> Config:
        """The files of ``configs`` with the options that override them. Raises ConfigError."""
        replace = msgspec.structs.replace
        config = configuration.load([*self.configs])
        source, start = self.source or config.source.path, self.start or config.source.start
        return replace(
            config,
            source=replace(config.source, path=source, start=start),
            map=replace(config.map, path=str(self.map_path or config.map.path)),
            link=replace(config.link, device=self.link or config.link.device),
        )


@dataclass(frozen=True)
class RunCallbacks:
    """What the caller of a run wants to know. Called in the thread of the supervisor."""

    on_event: Callable[[ProcessEvent], None] | None = None  # all events of the processes
    # once, with the t_ns of the first Origin: the zero of a recorded source on the monotonic clock
    on_epoch: Callable[[int], None] | None = None
    on_run_dir: Callable[[RunDir], None] | None = None  # once, with the run folder


def run(
    options: RunOptions,
    callbacks: RunCallbacks = RunCallbacks(),
    *,
    stop: threading.Event | None = None,
    table: tuple[Process, ...] = PROCESSES,
    fork_server: ForkServer | None = None,
) -> int:
    """Runs until a signal, until ``stop`` is set, or until the end of the source if the options say so.

    ``fork_server``: one that the caller has started and closes; None: own one.

    Returns 0, or 1 when the link was given up, or the exit code of a process that could not start because of a user
    error, which is written to stderr in one line. Raises ConfigError, MapError, OutputError before any start."""
    config = options.config()
    table = _configured(table, config)
    out_dir = _writable(options.out_dir)
    package = _map_package(config.map.path)
    with contextlib.ExitStack() as stack:
        output = stack.enter_context(options.log_to.open("a", encoding="utf-8")) if options.log_to else None
        stack.enter_context(
            contextlib.closing(logs.configure(config.log.level, SUPERVISOR, output or systemd.log_stream()))
        )
        logs.get().info(
            "start", config=msgspec.to_builtins(without_passwords(config)), map=str(package), out_dir=str(out_dir)
        )
        spec = msgspec.json.encode(spec_of(table, config, package, out_dir, options.ground_amsl_m))
        owned = OwnedRunDir(spec=spec, resume=is_camera(config.source.path))
        stack.callback(owned.remove)
        if callbacks.on_run_dir:
            callbacks.on_run_dir(owned.run_dir)
        if owned.run_dir.epoch_ns is not None:
            logs.get().warning("resumes a run that was killed", epoch_ns=owned.run_dir.epoch_ns)
        stop_signal = stack.enter_context(StopSignal(signal.SIGTERM, signal.SIGINT))  # for the ordered stop
        context = stack.enter_context(zmq.Context())
        fork_server = fork_server or stack.enter_context(ForkServer(output))
        children = [ManagedProcess(process, owned.run_dir, fork_server) for process in table]
        supervisor = Supervisor(
            children,
            *_bus(stack, context, owned.run_dir, table),
            lambda: stop_signal() or (stop is not None and stop.is_set()),
            options.stop_after_source,
            callbacks.on_event,
        )
        if callbacks.on_epoch:
            supervisor.report_epoch(owned.run_dir, callbacks.on_epoch)
        owned.keep_for_successor = True  # also when a bug ends this process
        code = supervisor.run()
        owned.keep_for_successor = code == LINK_GAVE_UP
    _write_user_errors(children)
    return code


def _bus(
    stack: contextlib.ExitStack, context: zmq.Context[zmq.Socket[bytes]], run_dir: RunDir, table: tuple[Process, ...]
) -> tuple[Publisher, Subscriber]:
    """Publisher and subscriber of the supervisor, closed by ``stack``."""
    publisher = Publisher(context, run_dir.address(SUPERVISOR))
    stack.callback(publisher.close)
    subscriber = Subscriber(context, [run_dir.address(p.name) for p in table], (SourceEnded,))
    stack.callback(subscriber.close)
    return publisher, subscriber


def _write_user_errors(children: list[ManagedProcess]) -> None:
    """Writes user errors to stderr. Called after all logs are written, so that they are the last lines."""
    for user_error in (child.user_error for child in children if child.user_error):
        sys.stderr.write(f"terrafix: {user_error.text}\n")


def recently_killed_spec(options: RunOptions) -> Spec | None:
    """The spec of a run with the same options that was killed in the flight in progress.

    With it a restart in flight need not inspect the map again. None: there is no such run. Raises ConfigError."""
    config = options.config()
    if not config.map.path or not is_camera(config.source.path):
        return None
    for killed in recently_killed_runs():
        with contextlib.suppress(OSError, msgspec.DecodeError):  # the folder is being removed, or of another version
            spec = msgspec.json.decode(killed.spec.read_bytes(), type=Spec)
            package = Path(config.map.path).resolve()
            table = _configured(PROCESSES, config)
            if spec == spec_of(table, config, package, options.out_dir.resolve(), spec.ground_amsl_m):
                return spec
    return None


def _configured(table: tuple[Process, ...], config: Config) -> tuple[Process, ...]:
    """-> the processes of ``table`` that are not switched off."""
    return tuple(p for p in table if p.name != SMOOTHER or config.smoother.enabled)


class Supervisor:
    def __init__(
        self,
        children: list[ManagedProcess],
        publisher: Publisher,
        subscriber: Subscriber,
        stopping: Callable[[], bool],
        stop_after_source: bool,
        on_event: Callable[[ProcessEvent], None] | None,
    ) -> None:
        self._children = children
        self._publisher = publisher
        self._subscriber = subscriber
        self._stopping = stopping
        self._stop_after_source = stop_after_source
        self._on_event = on_event
        self._message_log = MessageLog()
        self._check_epoch: Callable[[], bool] | None = None  # returns False when the epoch has been reported
        self._source_ended_ns: int | None = None  # time at which the source ended
        self._busy_ns = 0  # time at which a process was last busy
        self._ready_notified = False
        self._notify_ticker = Ticker(NOTIFY_HZ, now_ns())

    def report_epoch(self, run_dir: RunDir, on_epoch: Callable[[int], None]) -> None:
        """The loop will call ``on_epoch`` once with the epoch of the run."""

        def check() -> bool:
            epoch_ns = run_dir.epoch_ns
            if epoch_ns is not None:
                on_epoch(epoch_ns)
            return epoch_ns is None

        self._check_epoch = check

    def run(self) -> int:
        """Runs the loop, then the ordered stop -> exit code."""
        try:
            while (code := self._watch(now_ns())) is None:
                self._subscriber.socket.poll(LOOP_MS)
            return code
        finally:
            systemd.notify("STOPPING=1")
            for child in reversed(self._children):
                event = child.stop()
                if event:
                    self._publish(child, event)
                child.progress.close()

    def _watch(self, now: int) -> int | None:
        """One check of all processes; a returned exit code ends the run."""
        for child in self._children:
            for event in child.check(now):
                self._publish(child, event)
            if child.user_error is not None:
                return child.user_error.exit_code
            if child.process.name == REQUIRED_PROCESS and child.state in (State.GAVE_UP, State.FINISHED):
                return LINK_GAVE_UP
        if self._check_epoch and not self._check_epoch():
            self._check_epoch = None
        self._publisher.serve()
        for line in logs.take_lines():
            self._publisher.publish(LogLine(process=SUPERVISOR, **line))
        for _ in self._subscriber.receive():  # the supervisor subscribes to SourceEnded only
            self._source_ended_ns = self._source_ended_ns or now
        self._notify(now)
        if self._stopping() or (self._stop_after_source and self._is_drained(now)):
            return 0
        return None

    def _is_drained(self, now: int) -> bool:
        """Whether all messages of the source are processed. Processes with ticks never finish and do not count."""
        if self._source_ended_ns is None:
            return False
        workers = [c for c in self._children if c.process.tick_hz == 0 and c.state is State.RUNNING]
        if not all(c.progress.idle and now - c.progress.stamp_ns < FRESH_NS for c in workers):
            self._busy_ns = now
        idle_since_ns = max(self._busy_ns, self._source_ended_ns)
        return now - idle_since_ns > QUIET_NS or now - self._source_ended_ns > DRAIN_LIMIT_NS

    def _publish(self, child: ManagedProcess, event: Event) -> None:
        """Logs the event and publishes it as ProcessEvent."""
        message = ProcessEvent(t_ns=now_ns(), process=child.process.name, event=event.name, detail=event.detail)
        logs.write(self._message_log.entry(message))
        self._publisher.publish(message)
        if self._on_event:
            self._on_event(message)

    def _notify(self, now: int) -> None:
        if not self._notify_ticker.due(now):
            return
        if not self._ready_notified and all(c.settled for c in self._children):
            self._ready_notified = True
            systemd.notify("READY=1")
        if self._ready_notified and self._makes_progress(now):
            down = [c.process.name for c in self._children if c.state is not State.RUNNING]
            systemd.notify("WATCHDOG=1\nSTATUS=" + (f"flying without {', '.join(down)}" if down else "flying"))

    def _makes_progress(self, now: int) -> bool:
        """Whether the link makes progress; in a table without link, whether all processes do."""
        required = [c for c in self._children if c.process.name == REQUIRED_PROCESS] or self._children
        return all(now - c.progress.stamp_ns < c.process.stuck_after_s * 1e9 for c in required)


def _writable(out_dir: Path) -> Path:
    """-> the absolute path. Raises OutputError for a folder that cannot be made or written, unless the disk is the
    reason: then the vehicle flies without a record, and the recorder says so."""
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out_dir):
            pass
    except OSError as error:
        if error.errno in DISK_FAILURES:
            return out_dir.absolute()
        raise OutputError(f"{out_dir}: cannot be written ({error.strerror}); give another folder with --out") from None
    return out_dir.resolve()


def _map_package(path: str) -> Path | None:
    if not path:
        return None
    try:
        with Path(path).open("rb") as file:
            start = file.read(len(SQLITE_MAGIC))
    except OSError as error:
        raise MapError(f"{path}: map cannot be read ({error.strerror}); check --map or [map] path") from None
    if start != SQLITE_MAGIC:
        raise MapError(f"{path}: not a map package; make one with 'terrafix map build {path} --out MAP.gpkg'")
    return Path(path).resolve()
