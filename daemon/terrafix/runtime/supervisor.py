"""The supervisor: starts the processes in table order, watches their progress, restarts them, stops them in reverse.

The only code that talks to systemd. Its own loop does little, so that it can be trusted to go on: what flies is in
the processes. Only the link is worth taking the unit down; when another process gives up, the rest flies on and
says so."""

import contextlib
import os
import signal
import socket
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path

import msgspec
import zmq

from terrafix.core import config as configuration
from terrafix.core import logs
from terrafix.core.clock import Ticker, now_ns
from terrafix.core.config import Config
from terrafix.core.errors import MapError, OutputError
from terrafix.messages import ProcessEvent, SourceEnded
from terrafix.processes import PROCESSES, SUPERVISOR, Process
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.fork_server import ForkServer
from terrafix.runtime.managed_process import Event, ManagedProcess, State
from terrafix.runtime.run_dir import OwnedRunDir, RunDir, killed_in_flight
from terrafix.runtime.run_spec import Spec, spec_of
from terrafix.runtime.stop_signal import StopSignal

LINK_GAVE_UP = 1  # exit code
VITAL = "link"  # without it nothing leaves for the autopilot: systemd shall start everything anew
LOOP_MS = 50  # a death is noticed within this time
QUIET_NS = 1_000_000_000  # the source has ended and everybody was idle for this long: all is said
DRAIN_LIMIT_NS = 60_000_000_000  # ... or this long has passed since it ended
FRESH_NS = 500_000_000  # a progress stamp that is older belongs to a process in the middle of its work
NOTIFY_HZ = 2.0  # WATCHDOG=1; the unit's WatchdogSec is several times longer
SQLITE_MAGIC = b"SQLite format 3\0"  # a map package is a GeoPackage, and that is SQLite


def run(
    *,
    source: str,
    map_path: Path | None,
    link: str,
    out_dir: Path,
    configs: list[Path],
    start: str = "",
    ground_amsl_m: float | None = None,
    stop_after_source: bool = False,
    on_event: Callable[[ProcessEvent], None] | None = None,
    on_epoch: Callable[[int], None] | None = None,
    stop: threading.Event | None = None,
    log_to: Path | None = None,
    table: tuple[Process, ...] = PROCESSES,
    fork_server: ForkServer | None = None,
) -> int:
    """Flies until a signal, until ``stop`` is set, or (``stop_after_source``) until the source has ended.

    ``source``, ``map_path`` (a map package), ``link``, ``start`` ("LAT,LON"): win over the configuration when not
    empty. ``ground_amsl_m``: the map's ground at the start, for a source that does not know it.
    ``on_event`` gets everything that happens to the processes, ``on_epoch`` once the t_ns of the first Origin:
    the zero of a recorded source on the monotonic clock. ``log_to``: file for all logs and tracebacks instead of
    stdout and stderr. ``fork_server``: one that has been started before, by whom it will be closed; None: one of its
    own. Returns 0, or 1 when the link gave up, or the exit code of a process that could not start for a reason that the
    user can mend (said on stderr, in one line, at the end). Raises ConfigError, MapError, OutputError before anything
    is started."""
    config = _with_overrides(configuration.load(configs), source, start, map_path, link)
    out_dir = _writable(out_dir)
    package = _map_package(config.map.path)
    with contextlib.ExitStack() as stack:
        output = stack.enter_context(log_to.open("a", encoding="utf-8")) if log_to else None
        stack.enter_context(contextlib.closing(logs.configure(config.log.level, SUPERVISOR, output)))
        logs.get().info("start", config=msgspec.to_builtins(config), map=str(package), out_dir=str(out_dir))
        spec = msgspec.json.encode(spec_of(table, config, package, out_dir, ground_amsl_m))
        owned = OwnedRunDir(spec=spec, goes_on=_is_camera(config.source.path))
        stack.callback(owned.remove)
        if owned.run_dir.epoch_ns is not None:
            logs.get().warning("goes on from a run that was killed", epoch_ns=owned.run_dir.epoch_ns)
        asked = stack.enter_context(StopSignal(signal.SIGTERM, signal.SIGINT))  # for the ordered stop
        context = stack.enter_context(zmq.Context())
        fork_server = fork_server or stack.enter_context(ForkServer(output))
        children = [ManagedProcess(process, owned.run_dir, fork_server) for process in table]
        publisher = Publisher(context, owned.run_dir.address(SUPERVISOR))
        stack.callback(publisher.close)
        subscriber = Subscriber(context, [owned.run_dir.address(p.name) for p in table], (SourceEnded,))
        stack.callback(subscriber.close)
        supervisor = Supervisor(
            children,
            publisher,
            subscriber,
            lambda: asked() or (stop is not None and stop.is_set()),
            stop_after_source,
            on_event,
        )
        if on_epoch:
            supervisor.tell_epoch(owned.run_dir, on_epoch)
        owned.left = True  # after a bug, too
        code = supervisor.run()
        owned.left = code == LINK_GAVE_UP
    for mistake in (child.mistake for child in children if child.mistake):
        sys.stderr.write(f"terrafix: {mistake.text}\n")  # the last word, after all logs
    return code


def killed_just_now(
    *, source: str, map_path: Path | None, link: str, out_dir: Path, configs: list[Path], start: str = ""
) -> Spec | None:
    """What a run of the same (as for ``run``) flew with, if it was killed in the flight that goes on now: the map, as
    it was looked at on the ground, need not be looked at again while a vehicle waits. None: there was none.
    Raises ConfigError."""
    config = _with_overrides(configuration.load(configs), source, start, map_path, link)
    if not config.map.path or not _is_camera(config.source.path):
        return None
    for dead in killed_in_flight():
        with contextlib.suppress(OSError, msgspec.DecodeError):  # it is being removed; of another version
            spec = msgspec.json.decode(dead.spec.read_bytes(), type=Spec)
            package = Path(config.map.path).resolve()
            if spec == spec_of(PROCESSES, config, package, out_dir.resolve(), spec.ground_amsl_m):
                return spec
    return None


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
        self._look_for_epoch: Callable[[], bool] | None = None  # False: found, look no more
        self._ended_ns: int | None = None  # the source has ended
        self._busy_ns = 0  # somebody was last seen at work
        self._ready_said = False
        self._notify_ticker = Ticker(NOTIFY_HZ, now_ns())

    def tell_epoch(self, run_dir: RunDir, on_epoch: Callable[[int], None]) -> None:
        """``on_epoch`` will be called once, from the loop."""

        def look() -> bool:
            epoch_ns = run_dir.epoch_ns
            if epoch_ns is not None:
                on_epoch(epoch_ns)
            return epoch_ns is None

        self._look_for_epoch = look

    def run(self) -> int:
        """The loop, and the ordered stop after it."""
        try:
            while (code := self._watch(now_ns())) is None:
                self._subscriber.socket.poll(LOOP_MS)
            return code
        finally:
            sd_notify("STOPPING=1")
            for child in reversed(self._children):
                event = child.stop()
                if event:
                    self._say(child, event)
                child.progress.close()

    def _watch(self, now: int) -> int | None:
        """One look at everything; an exit code ends the run."""
        for child in self._children:
            for event in child.check(now):
                self._say(child, event)
            if child.mistake is not None:
                return child.mistake.exit_code
            if child.process.name == VITAL and child.state in (State.GAVE_UP, State.FINISHED):
                return LINK_GAVE_UP
        if self._look_for_epoch and not self._look_for_epoch():
            self._look_for_epoch = None
        self._publisher.serve()
        for _ in self._subscriber.receive():  # SourceEnded is all that the supervisor hears
            self._ended_ns = self._ended_ns or now
        self._notify(now)
        if self._stopping() or (self._stop_after_source and self._is_drained(now)):
            return 0
        return None

    def _is_drained(self, now: int) -> bool:
        """Everything that the source gave has been worked on. Processes that tick are never done: they do not count."""
        if self._ended_ns is None:
            return False
        workers = [c for c in self._children if c.process.tick_hz == 0 and c.state is State.RUNNING]
        if not all(c.progress.idle and now - c.progress.stamp_ns < FRESH_NS for c in workers):
            self._busy_ns = now
        return now - max(self._busy_ns, self._ended_ns) > QUIET_NS or now - self._ended_ns > DRAIN_LIMIT_NS

    def _say(self, child: ManagedProcess, event: Event) -> None:
        log = logs.get().info if event.name in ("started", "stopped") else logs.get().warning
        if event.name == "gave_up":
            log = logs.get().error
        log("process " + event.name, child=child.process.name, detail=event.detail)
        message = ProcessEvent(t_ns=now_ns(), process=child.process.name, event=event.name, detail=event.detail)
        self._publisher.say(message)
        if self._on_event:
            self._on_event(message)

    def _notify(self, now: int) -> None:
        if not self._notify_ticker.due(now):
            return
        if not self._ready_said and all(c.settled for c in self._children):
            self._ready_said = True
            sd_notify("READY=1")
        if self._ready_said and self._makes_progress(now):
            down = [c.process.name for c in self._children if c.state is not State.RUNNING]
            sd_notify("WATCHDOG=1\nSTATUS=" + (f"flying without {', '.join(down)}" if down else "flying"))

    def _makes_progress(self, now: int) -> bool:
        """The link does (every process does, in a table without a link)."""
        vital = [c for c in self._children if c.process.name == VITAL] or self._children
        return all(now - c.progress.stamp_ns < c.process.stuck_after_s * 1e9 for c in vital)


def sd_notify(state: str) -> None:
    """sd_notify(3) by hand: a datagram, and nothing without systemd."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]  # abstract namespace
    kind = socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
    # A systemd that does not listen must not end a flight; its watchdog is the check on that.
    with socket.socket(socket.AF_UNIX, kind) as sock, contextlib.suppress(OSError):
        sock.sendto(state.encode(), address)


def _with_overrides(config: Config, source: str, start: str, map_path: Path | None, link: str) -> Config:
    replace = msgspec.structs.replace
    if source:
        config = replace(config, source=replace(config.source, path=source))
    if start:
        config = replace(config, source=replace(config.source, start=start))
    if map_path:
        config = replace(config, map=replace(config.map, path=str(map_path)))
    if link:
        config = replace(config, link=replace(config.link, device=link))
    return config


def _is_camera(source: str) -> bool:
    """A recording is not flown on with: it begins anew."""
    return source.startswith("/dev/") or not os.path.exists(os.path.expanduser(source))


def _writable(out_dir: Path) -> Path:
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out_dir):
            pass
    except OSError as error:
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
