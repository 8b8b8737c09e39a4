"""Pairs the messages of two records of one flight, with one digest a message, so that an hour fits into memory.

A message is identified by its type and by what it is about: its frame, else its time since the start of the flight,
with the name of its measurement where it has one, and a running number of those that share all these."""

import hashlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from terrafix.core.errors import SourceError
from terrafix.messages import Imu, InputOrder, MeasurementVerdict, Message, NavEstimate, Origin
from terrafix.processes import PROCESSES
from terrafix.recorder.reader import ReadResult, check_format, read_received
from terrafix_tools.log.edit import origin_of

NS = 1_000_000_000
DIGEST_BYTES = 8  # of each message; two different ones are taken for equal once in 1e19 pairs
# Clock readings of the computer: not part of the result, compared as timing.
CLOCK_FIELDS = ("emitted_at_ns",)
# Fields with times on the clock of the flight, compared from its start.
TIME_FIELDS = ("t_ns", "prior_t_ns")
# Messages with further times in their contents: compared only when both records have the same clock.
CLOCKED: tuple[type[Message], ...] = (Imu, InputOrder)
# What a replay can have: the messages of its processes (docs/architecture.md).
REPLAYED = frozenset(
    kind.__name__
    for process in PROCESSES
    if process.name in ("vision", "anchor", "estimator")
    for kind in process.publishes
)


class Key(NamedTuple):
    kind: str  # message type
    frame_id: int  # -1: none
    t_ns: int  # since the Origin; 0 where frame_id identifies the message
    measurement: str  # "" without one
    number: int  # of those with equal other fields, in the order of the record


class ComparedEstimate(NamedTuple):
    """What is compared of a NavEstimate beside its digest; the last one of a frame counts."""

    t_s: float
    lat_deg: float
    lon_deg: float
    delay_ms: float  # from exposure to publication


@dataclass
class ComparedRecord:
    """One read record: digests by key in the order of the record; times [s] since the start, and estimates, by frame;
    numbers of verdicts."""

    path: Path
    result: ReadResult
    origin: Origin
    digests: dict[Key, bytes] = field(default_factory=dict)
    frame_t_s: dict[int, float] = field(default_factory=dict)
    estimates: dict[int, ComparedEstimate] = field(default_factory=dict)
    verdicts: Counter[tuple[str, str]] = field(default_factory=Counter)  # measurement, verdict
    verdict_of: dict[Key, str] = field(default_factory=dict)  # of each MeasurementVerdict


def read_record(path: Path) -> ComparedRecord:
    """Reads all messages of a record (a file, or the folder of a replay or run). Raises SourceError."""
    result = ReadResult()
    record: ComparedRecord | None = None
    for key, message in keyed(path, result):
        if record is None:
            origin = origin_of(path)
            record = ComparedRecord(path, result, origin)
        record.digests[key] = digest(message, record.origin.t_ns)
        if key.frame_id >= 0:
            record.frame_t_s.setdefault(key.frame_id, (message.t_ns - record.origin.t_ns) / NS)
        if isinstance(message, NavEstimate):
            record.estimates[message.frame_id] = _estimate(message, record.origin.t_ns)
        elif isinstance(message, MeasurementVerdict):
            record.verdicts[message.measurement, str(message.verdict)] += 1
            record.verdict_of[key] = str(message.verdict)
    check_format(path, result)
    if record is None:
        raise SourceError(f"{path}: the record has no messages; give the output of replay or run")
    return record


def keyed(path: Path, result: ReadResult) -> Iterator[tuple[Key, Message]]:
    """Yields each message of the record with its key, in the order of the record."""
    zero_ns = origin_of(path).t_ns
    seen: Counter[tuple[str, int, int, str]] = Counter()
    for _, _, _, message in read_received(path, result):
        if isinstance(message, Origin) and seen[("Origin", -1, 0, "")]:
            continue  # the first message of each segment repeats it
        frame_id = getattr(message, "frame_id", -1)
        about = (
            type(message).__name__,
            frame_id,
            0 if frame_id >= 0 else message.t_ns - zero_ns,
            str(getattr(message, "measurement", "")),
        )
        yield Key(*about, seen[about]), message
        seen[about] += 1


def contents(message: Message, zero_ns: int) -> dict[str, Any]:
    """The compared fields of a message, with times since ``zero_ns``."""
    fields = msgspec.to_builtins(message)
    for name in CLOCK_FIELDS:
        fields.pop(name, None)
    for name in TIME_FIELDS:
        if fields.get(name) is not None:
            fields[name] -= zero_ns
    return dict(fields)


def digest(message: Message, zero_ns: int) -> bytes:
    return hashlib.blake2b(msgspec.msgpack.encode(contents(message, zero_ns)), digest_size=DIGEST_BYTES).digest()


def _estimate(message: NavEstimate, zero_ns: int) -> ComparedEstimate:
    delay_ms = (message.emitted_at_ns - message.t_ns) / 1e6
    return ComparedEstimate((message.t_ns - zero_ns) / NS, message.lat_deg, message.lon_deg, delay_ms)
