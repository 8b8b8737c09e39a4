"""Structured logs: one JSON object per line on stdout, or an entry of the systemd journal with fields (ON-8).

Logging does not block. ERROR: data or a function is lost, and the line has a field ``todo``; WARN: degraded operation;
INFO: change of state; DEBUG: for developers. The lines of an event are limited (``RateLimit``). The record has WARN and
ERROR whatever the level is."""

import atexit
import json
import logging
import queue
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Protocol

from terrafix.core.clock import NS_PER_S, now_ns
from terrafix.core.log_lines import LogEntry

# structlog imports rich, where installed, for coloured tracebacks, which are not used here. The import costs 0.1 s of
# CPU time in each of seven processes, which delays a restart in flight.
_HIDDEN = "rich"
if _HIDDEN not in sys.modules:
    sys.modules[_HIDDEN] = None  # type: ignore[assignment]  # makes `import` raise ModuleNotFoundError
    import structlog

    del sys.modules[_HIDDEN]
else:
    import structlog

LOG_QUEUE_LENGTH = 2000  # lines; when the reader of stdout hangs, lines are lost instead of the process blocking
EXIT_FLUSH_S = 1.0  # time limit for writing the queued lines at exit
EVENT_BURST = 10  # lines of one event within BURST_NS; more are counted. All processes start with one line each
BURST_NS = 10 * NS_PER_S
KEPT_LINES = 200  # that wait for the record
FROM_MESSAGE = "_from_message"  # field of lines whose message is in the record
LOG_LEVELS = {"DEBUG": logging.DEBUG, "INFO": logging.INFO, "WARN": logging.WARNING, "ERROR": logging.ERROR}


class LineStream(Protocol):
    """Where lines go: a text file, or the journal (runtime/systemd.py). Each call has one line."""

    def write(self, text: str, /) -> object: ...
    def flush(self) -> object: ...


class LineWriter:
    """Queue of lines that a thread writes to ``stream``. When the queue is full, lines are dropped and counted."""

    def __init__(self, stream: LineStream) -> None:
        self._stream = stream
        self._queue: queue.Queue[str | None] = queue.Queue(LOG_QUEUE_LENGTH)
        self._lost = 0
        self._thread = threading.Thread(target=self._write_all, name="log-writer", daemon=True)
        self._thread.start()

    def write(self, line: str) -> None:
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self._lost += 1

    def close(self) -> None:
        atexit.unregister(self.close)
        try:
            self._queue.put(None, timeout=EXIT_FLUSH_S)
        except queue.Full:
            return
        self._thread.join(EXIT_FLUSH_S)

    def _write_all(self) -> None:
        while (line := self._queue.get()) is not None:
            self._stream.write(line + "\n")
            if self._lost:
                lost, self._lost = self._lost, 0
                self._stream.write(json.dumps({"level": "warning", "event": "log lines lost", "count": lost}) + "\n")
            self._stream.flush()


class _Logger:
    """Last element of structlog's processor chain."""

    def __init__(self, writer: LineWriter) -> None:
        self._writer = writer

    def msg(self, line: str) -> None:
        self._writer.write(line)

    debug = info = warning = error = critical = msg


def _monotonic(_logger: Any, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    event["t_ns"] = now_ns()
    return event


class RateLimit:
    """At most EVENT_BURST lines of one event within BURST_NS. The next line after that says how many were left out
    (``suppressed``), so that a fault that repeats at the rate of frames fills neither the journal nor the record."""

    def __init__(self, clock: Callable[[], int] = now_ns) -> None:
        self._clock = clock
        self._times: dict[str, deque[int]] = {}
        self._suppressed: dict[str, int] = {}
        self._levels: dict[str, str] = {}  # of those, without lines of messages, which are in the record themselves

    def __call__(self, _logger: Any, method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
        name, now = str(event["event"]), self._clock()
        times = self._times.setdefault(name, deque(maxlen=EVENT_BURST))
        if len(times) == EVENT_BURST and now - times[0] < BURST_NS:
            self._suppressed[name] = self._suppressed.get(name, 0) + 1
            if not event.get(FROM_MESSAGE):
                self._levels[name] = method
            raise structlog.DropEvent
        times.append(now)
        suppressed = self._suppressed.pop(name, 0)
        self._levels.pop(name, None)
        return {**event, "suppressed": suppressed} if suppressed else event

    def counts(self, *, last: bool = False) -> Iterator[dict[str, Any]]:
        """Lines that no further line of their event has counted within BURST_NS, or at the ``last`` call: for the
        record, as ``take_lines``."""
        now = self._clock()
        for name, level in list(self._levels.items()):
            if last or now - self._times[name][0] >= BURST_NS:
                del self._levels[name]
                fields = {"suppressed": self._suppressed.pop(name)}
                yield {"t_ns": now, "level": level, "event": name, "fields": fields}


_lines: deque[dict[str, Any]] = deque(maxlen=KEPT_LINES)
_limit = RateLimit()


def _keep(_logger: Any, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    """Keeps a line for the record, unless its message is in the record."""
    if not event.pop(FROM_MESSAGE, False):
        fields = {k: _plain(v) for k, v in event.items() if k not in ("event", "level", "t_ns", "time")}
        line = {"t_ns": event["t_ns"], "level": event["level"], "event": str(event["event"]), "fields": fields}
        _lines.append(line)
    return event


def _plain(value: Any) -> str | int | float | bool | None:
    return value if value is None or type(value) in (str, int, float, bool) else str(value)


def take_lines(*, last: bool = False) -> Iterator[dict[str, Any]]:
    """The lines that this process has logged since the last call, as the fields of messages.LogLine, and the number of
    those that the limit has left out; those of messages are not among them. ``last``: there is no further call."""
    while _lines:
        yield _lines.popleft()
    yield from _limit.counts(last=last)


def write(entry: LogEntry | None) -> None:
    """Logs the line of a message that this process has published."""
    if entry is not None:
        getattr(get(), entry.level)(entry.event, **entry.fields, **{FROM_MESSAGE: True})


def configure(level: str, process: str, stream: LineStream | None = None) -> LineWriter:
    """Configures structlog for this process and returns the writer, which is closed at exit."""
    global _limit
    writer, _limit = LineWriter(stream or sys.stdout), RateLimit()
    structlog.configure(
        processors=[
            _limit,
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),  # for readers; t_ns is the reference
            _monotonic,
            structlog.processors.EventRenamer("event"),
            _keep,
            _from_level(level),
            structlog.processors.dict_tracebacks,
            _with_process(process),
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(min(LOG_LEVELS[level], logging.WARNING)),
        logger_factory=lambda *_: _Logger(writer),
        cache_logger_on_first_use=False,
    )
    atexit.register(writer.close)
    return writer


def _from_level(level: str) -> structlog.typing.Processor:
    def drop(_logger: Any, method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
        if logging.getLevelNamesMapping()[method.upper()] < LOG_LEVELS[level]:
            raise structlog.DropEvent
        return event

    return drop


def _with_process(process: str) -> structlog.typing.Processor:
    def add(_logger: Any, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
        return {"process": process, **event}

    return add


def get() -> structlog.typing.FilteringBoundLogger:
    """The logger of this process: ``get().warning("what happened", key=value)``."""
    return structlog.get_logger()
