"""Structured logs: one JSON object per line on stdout, which systemd forwards to the journal. Logging does not block.

ERROR: data or a function is lost; WARN: degraded operation; INFO: change of state; DEBUG: for developers."""

import atexit
import json
import logging
import queue
import sys
import threading
from typing import Any, TextIO

from terrafix.core.clock import now_ns

# structlog imports rich, where installed, for coloured tracebacks, which are not used here. The import costs 0.1 s of
# CPU time in each of seven processes, which delays a restart in flight.
_HIDDEN = "rich"
if _HIDDEN not in sys.modules:
    sys.modules[_HIDDEN] = None  # type: ignore[assignment]  # makes `import` raise ModuleNotFoundError
    import structlog

    del sys.modules[_HIDDEN]
else:
    import structlog

QUEUE_LENGTH = 2000  # lines; when the reader of stdout hangs, lines are lost instead of the process blocking
FLUSH_S = 1.0  # time limit for writing the queued lines at exit
LEVELS = {"DEBUG": logging.DEBUG, "INFO": logging.INFO, "WARN": logging.WARNING, "ERROR": logging.ERROR}


class LineWriter:
    """Queue of lines that a thread writes to ``stream``. When the queue is full, lines are dropped and counted."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._queue: queue.Queue[str | None] = queue.Queue(QUEUE_LENGTH)
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
            self._queue.put(None, timeout=FLUSH_S)
        except queue.Full:
            return
        self._thread.join(FLUSH_S)

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


def configure(level: str, process: str, stream: TextIO | None = None) -> LineWriter:
    """Configures structlog for this process and returns the writer, which is closed at exit."""
    writer = LineWriter(stream or sys.stdout)
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),  # for readers; t_ns is the reference
            _monotonic,
            structlog.processors.EventRenamer("event"),
            structlog.processors.dict_tracebacks,
            _with_process(process),
            structlog.processors.JSONRenderer(),
        ],
        wrapper_class=structlog.make_filtering_bound_logger(LEVELS[level]),
        logger_factory=lambda *_: _Logger(writer),
        cache_logger_on_first_use=False,
    )
    atexit.register(writer.close)
    return writer


def _with_process(process: str) -> structlog.typing.Processor:
    def add(_logger: Any, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
        return {"process": process, **event}

    return add


def get() -> structlog.typing.FilteringBoundLogger:
    """The logger of this process: ``get().warning("what happened", key=value)``."""
    return structlog.get_logger()
