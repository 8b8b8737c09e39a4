"""Reads a flight record, whole or cut off: one file, or a folder with the segments of a flight."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

import msgspec
import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from terrafix.core.errors import SourceError
from terrafix.messages import Message
from terrafix.recorder.schema import THUMBNAIL_TOPIC, TYPE_BY_TOPIC
from terrafix.recorder.writer import HEADER_NAME, decode_thumbnail

_SEGMENT = re.compile(r"flight-(\d+)\.mcap$")
_RECORD_LIMIT_BYTES = 64 * 1024 * 1024  # above any record of ours; a torn length field must not ask for gigabytes

# What a torn record may raise, besides its own end: lengths, compression and text of bytes that were never written.
_TORN = (McapError, struct.error, zstandard.ZstdError, UnicodeDecodeError, msgspec.DecodeError)

_decoders = {topic: msgspec.json.Decoder(t) for topic, t in TYPE_BY_TOPIC.items()}


@dataclass
class ReadResult:
    """What reading met; filled while the iterator runs."""

    header: dict[str, Any] = field(default_factory=dict)  # format, config, versions of the first file
    files: list[Path] = field(default_factory=list)
    cut_off: list[Path] = field(default_factory=list)  # files without their end (killed, power cut, disk full)
    undecodable: int = 0  # messages of another version of this program
    segment_starts_ns: list[int] = field(default_factory=list)  # publish time of the first message of each file


def flight_files(path: Path) -> list[Path]:
    """The record files of a folder, oldest first; a file is itself. Raises SourceError when there is none."""
    if path.is_file():
        return [path]
    segments = sorted((int(hit.group(1)), p) for p in path.glob("flight-*.mcap") if (hit := _SEGMENT.search(p.name)))
    files = [p for _, p in segments]
    # A replay: its record, or what a killed one left.
    files += [p for name in ("flight.mcap", "flight.mcap.partial") if (p := path / name).is_file()][:1]
    if not files:
        raise SourceError(
            f"{path}: no flight record here (flight.mcap or flight-000.mcap); give a replay or run folder"
        )
    return files


def read_flight(path: Path, result: ReadResult | None = None) -> Iterator[tuple[str, int, Message]]:
    """Yields (topic, log_time_ns, message) in the order heard, over all files; thumbnails are left out."""
    for topic, log_ns, _, message in read_heard(path, result):
        yield topic, log_ns, message


def read_heard(path: Path, result: ReadResult | None = None) -> Iterator[tuple[str, int, int, Message]]:
    """Like read_flight, with the time at which the recorder heard it: (topic, log_time_ns, heard_ns, message)."""
    found = ReadResult() if result is None else result
    for channel, record in _records(path, found):
        decoder = _decoders.get(channel.topic)
        if decoder is None:
            continue
        try:
            message = decoder.decode(record.data)
        except msgspec.MsgspecError:
            found.undecodable += 1
            continue
        yield channel.topic, record.log_time, record.publish_time, message


def read_thumbnails(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yields (frame id, JPEG)."""
    for channel, record in _records(path, ReadResult()):
        if channel.topic == THUMBNAIL_TOPIC:
            yield decode_thumbnail(record.data)


class _Exact:
    """A stream whose read() gives what was asked for or says that the file is over; mcap takes short reads as whole."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream

    def read(self, length: int) -> bytes:
        data = self._stream.read(length)
        if len(data) < length:
            raise EndOfFile
        return data


def _records(path: Path, found: ReadResult) -> Iterator[tuple[Channel, McapMessage]]:
    for file in flight_files(path):
        found.files.append(file)
        with file.open("rb") as stream:
            yield from _records_of(file, stream, found)


def _records_of(file: Path, stream: IO[bytes], found: ReadResult) -> Iterator[tuple[Channel, McapMessage]]:
    """Sequential, because the index at the end is what a cut-off file lacks."""
    channels: dict[int, Channel] = {}
    first = True
    try:
        for record in StreamReader(cast(IO[bytes], _Exact(stream)), record_size_limit=_RECORD_LIMIT_BYTES).records:
            if isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata) and record.name == HEADER_NAME and not found.header:
                found.header = {
                    "format": record.metadata.get("format", ""),
                    "config": msgspec.json.decode(record.metadata.get("config", "{}")),
                    "versions": msgspec.json.decode(record.metadata.get("versions", "{}")),
                }
            elif isinstance(record, McapMessage) and record.channel_id in channels:
                if first:
                    found.segment_starts_ns.append(record.publish_time)
                    first = False
                yield channels[record.channel_id], record
    except _TORN:
        # The file ends, or is torn, in the middle of a record; what came before it is good.
        found.cut_off.append(file)
