"""`terrafix log show`: messages of a record as lines of text, also while it is written."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec

from terrafix.core.errors import UsageError
from terrafix.messages import Message, Origin
from terrafix.recorder.reader import ReadResult, check_format, read_received
from terrafix.recorder.schema import MESSAGE_TYPES

NS = 1_000_000_000
MAX_VALUE = 60  # characters of a value
FOLLOW_S = 0.5  # interval at which a record that is being written is read again


class Selection(msgspec.Struct, frozen=True):
    """``kinds``: message types, empty for all. Times in seconds since the start of the flight."""

    kinds: tuple[str, ...] = ()
    from_s: float = float("-inf")
    to_s: float = float("inf")

    def takes(self, message: Message, t_s: float) -> bool:
        return (not self.kinds or type(message).__name__ in self.kinds) and self.from_s <= t_s <= self.to_s


def checked_kinds(names: list[str]) -> tuple[str, ...]:
    """Raises UsageError for a name that is no message type."""
    for name in names:
        if name not in MESSAGE_TYPES:
            raise UsageError(f"--message '{name}': no such message; known: {', '.join(sorted(MESSAGE_TYPES))}")
    return tuple(names)


def lines(path: Path, selection: Selection) -> Iterator[str]:
    """Yields a line for each selected message, in the order of the record. Raises SourceError."""
    result = ReadResult()
    zero_ns: int | None = None
    for _, t_ns, _, message in read_received(path, result):
        if isinstance(message, Origin) and zero_ns is None:
            zero_ns = message.t_ns
        t_s = (t_ns - (zero_ns or 0)) / NS if zero_ns is not None else 0.0
        if selection.takes(message, t_s):
            yield line_of(message, t_s)
    check_format(path, result)


def follow(
    path: Path, selection: Selection, sleep: Callable[[float], None] = time.sleep, rounds: int | None = None
) -> Iterator[str]:
    """Like ``lines``, and goes on with what is written later. ``rounds``: number of readings; None: without end.

    A record is read again from its beginning: its last chunk may have been incomplete."""
    shown = 0
    while rounds is None or rounds > 0:
        count = 0
        for line in lines(path, selection):
            count += 1
            if count > shown:
                yield line
        shown = max(shown, count)
        rounds = None if rounds is None else rounds - 1
        sleep(FOLLOW_S)


def line_of(message: Message, t_s: float) -> str:
    """ "  12.345 NavEstimate frame_id=24 lat_deg=48.1 ...": fields that differ from their default, shortened."""
    values = {name: value for name, value in msgspec.to_builtins(message).items() if name not in ("t_ns", "type")}
    return f"{t_s:10.3f} {type(message).__name__} {' '.join(f'{k}={_short(v)}' for k, v in values.items())}"


def _short(value: Any) -> str:
    text = f"{value:.7g}" if isinstance(value, float) and abs(value) < 1e5 else str(value)
    return text if len(text) <= MAX_VALUE else f"{text[: MAX_VALUE - 3]}..."
