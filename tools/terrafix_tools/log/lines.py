"""`terrafix log lines`: the log of a flight from its record."""

from collections.abc import Iterator
from pathlib import Path

from terrafix.core.errors import UsageError
from terrafix.core.log_lines import MessageLog
from terrafix.messages import Message, Origin
from terrafix.recorder.reader import ReadResult, check_format, read_received

NS = 1_000_000_000
LEVELS = ("debug", "info", "warning", "error")


def log_lines(path: Path, level: str, from_s: float, to_s: float) -> Iterator[str]:
    """Yields "  12.345 warning link       GPS_INPUT has no fix, reason ...", seconds since the start of the flight, at
    ``level`` and above; lines before the start of the source have negative times. Raises SourceError, UsageError."""
    if level not in LEVELS:
        raise UsageError(f"--level '{level}': choose one of {', '.join(LEVELS)}")
    result, log = ReadResult(), MessageLog()
    waiting: list[Message] = []  # before the first Origin, whose time is zero
    zero_ns: int | None = None
    for _, _, _, message in read_received(path, result):
        waiting.append(message)
        if isinstance(message, Origin) and zero_ns is None:
            zero_ns = message.t_ns
        if zero_ns is not None:
            yield from _lines_of(waiting, log, zero_ns, (level, from_s, to_s))
            waiting.clear()
    check_format(path, result)
    yield from _lines_of(waiting, log, waiting[0].t_ns if waiting else 0, (level, from_s, to_s))


def _lines_of(
    messages: list[Message], log: MessageLog, zero_ns: int, selection: tuple[str, float, float]
) -> Iterator[str]:
    level, from_s, to_s = selection
    for message in messages:
        entry, t_s = log.entry(message), (message.t_ns - zero_ns) / NS
        if entry is not None and LEVELS.index(entry.level) >= LEVELS.index(level) and from_s <= t_s <= to_s:
            yield f"{t_s:10.3f} {entry.level:7} {entry.part:10} {entry.text}"
