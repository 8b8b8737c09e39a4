"""Structured logs: one JSON object a line on stdout, which systemd carries to the journal. Logging never waits.

ERROR: something is lost or broken; WARN: it goes on, with less; INFO: a change of state; DEBUG: for the developer."""

import atexit
import json
import logging
import queue
import sys
import threading
from typing import Any, TextIO

from terrafix.core.clock import now_ns

# structlog loads rich where it is installed, for tracebacks in colour, which are never shown here: a tenth of a second
# of a processor for each of seven processes, when a flight waits for them to be there again.
_HIDDEN = "rich"
if _HIDDEN not in sys.modules:
    sys.modules[_HIDDEN] = None  # type: ignore[assignment]  # as `import` has it for what is not there
    import structlog

    del sys.modules[_HIDDEN]
else:
    import structlog

QUEUE_LENGTH = 2000  # lines; a reader of stdout that hangs costs lines, not flight time
FLUSH_S = 1.0  # last words at the end of the process, at most this long
LEVELS = {"DEBUG": logging.DEBUG, "INFO": logging.INFO, "WARN": logging.WARNING, "ERROR": logging.ERROR}


class LineWriter:
    """Lines in, a thread writes them. A full queue loses lines and says how many."""

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
    """The end of structlog's chain."""

    def __init__(self, writer: LineWriter) -> None:
        self._writer = writer

    def msg(self, line: str) -> None:
        self._writer.write(line)

    debug = info = warning = error = critical = msg


def _monotonic(_logger: Any, _method: str, event: structlog.typing.EventDict) -> structlog.typing.EventDict:
    event["t_ns"] = now_ns()
    return event


def configure(level: str, process: str, stream: TextIO | None = None) -> LineWriter:
    """Sets up structlog for this process and returns the writer (closed by itself at exit)."""
    writer = LineWriter(stream or sys.stdout)
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True, key="time"),  # for people; t_ns is the clock
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
