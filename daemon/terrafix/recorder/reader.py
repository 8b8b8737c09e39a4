"""Reads a flight record, complete, truncated or damaged: one file, or a folder with the segments of a flight."""

import re
import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile, InvalidMagic, McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Metadata, Statistics
from mcap.records import Message as McapMessage
from mcap.stream_reader import CRCValidationError, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from terrafix.core.errors import SourceError
from terrafix.messages import Message
from terrafix.recorder.foxglove import IMAGE_TOPIC, THUMBNAIL_TOPIC
from terrafix.recorder.provenance import RECORD_FORMAT
from terrafix.recorder.schema import TYPE_BY_TOPIC, topic_of
from terrafix.recorder.writer import CALIBRATION_NAME, HEADER_NAME, SOURCE_NAME, decode_image

_SEGMENT = re.compile(r"flight-(\d+)\.mcap$")
_RECORD_LIMIT_BYTES = 64 * 1024 * 1024  # more than any valid record; a corrupt length must not allocate gigabytes
_FRAMING = struct.Struct("<BQ")  # opcode and length of each record (https://mcap.dev/spec)
_FOOTER_BYTES = 20  # [spec: the same]

# Exceptions of a truncated or corrupt record: invalid length, compression, checksum or text.
_CORRUPT = (
    OverflowError,
    McapError,
    CRCValidationError,
    struct.error,
    zstandard.ZstdError,
    UnicodeDecodeError,
    msgspec.DecodeError,
)

_DAMAGED_IMAGE = (msgspec.DecodeError, KeyError, TypeError, ValueError)  # exceptions of decode_image

_DECODERS = {topic: msgspec.json.Decoder(t).decode for topic, t in TYPE_BY_TOPIC.items()}


@dataclass
class ReadResult:
    """Properties of the record, filled while the iterator of a read function runs."""

    # Of the first file: format, config, versions, map, models, device; calibration: camera of the flight; source: what
    # it says of itself, by topic
    header: dict[str, Any] = field(default_factory=dict)
    files: list[Path] = field(default_factory=list)
    truncated_files: list[Path] = field(default_factory=list)  # without their end (kill, power failure, full disk)
    damaged: list[str] = field(default_factory=list)  # parts that were left out: file, place and reason
    undecodable: int = 0  # messages of another version of this program
    segment_starts_ns: list[int] = field(default_factory=list)  # publish time of the first message of each file


def flight_files(path: Path) -> list[Path]:
    """The record files of a folder, oldest first; for a file, the file. Raises SourceError when there is none."""
    if path.is_file():
        return [path]
    segments = sorted((int(hit.group(1)), p) for p in path.glob("flight-*.mcap") if (hit := _SEGMENT.search(p.name)))
    files = [p for _, p in segments]
    # A replay writes one file: the complete record, or the partial one of a killed replay.
    files += [p for name in ("flight.mcap", "flight.mcap.partial") if (p := path / name).is_file()][:1]
    if not files:
        raise SourceError(
            f"{path}: no flight record here (flight.mcap or flight-000.mcap); give a replay or run folder"
        )
    return files


def is_record(path: Path) -> bool:
    """Whether ``path`` is a record file by its name, or a folder with one that is no recorded source (flight.toml)."""
    if path.is_dir():
        return not (path / "flight.toml").is_file() and any(path.glob("flight*.mcap*"))
    return path.name.endswith((".mcap", ".mcap.partial"))


def check_format(path: Path, result: ReadResult) -> None:
    """Raises SourceError when what was read of ``path`` is no flight record, or of a version that is not known."""
    where = ", ".join(file.name for file in result.files)
    if not result.header:
        raise SourceError(f"{path}: {where} is not a flight record, or ends before its head; give another")
    if result.header["format"] != RECORD_FORMAT:
        raise SourceError(
            f"{path}: {where} is a record of format '{result.header['format']}', and this program reads "
            f"'{RECORD_FORMAT}'; read it with the version that wrote it"
        )


def read_flight(path: Path, result: ReadResult | None = None) -> Iterator[tuple[str, int, Message]]:
    """Yields (topic, log_time_ns, message) in the order of reception, over all files, without thumbnails."""
    for topic, log_ns, _, message in read_received(path, result):
        yield topic, log_ns, message


def read_received(path: Path, result: ReadResult | None = None) -> Iterator[tuple[str, int, int, Message]]:
    """Like read_flight, with the reception time at the recorder: (topic, log_time_ns, received_ns, message)."""
    result = ReadResult() if result is None else result
    for channel, record in _records(path, result):
        message = _message(channel, record, result)
        if message is not None:
            yield topic_of(type(message)), record.log_time, record.publish_time, message


def _message(channel: Channel, record: McapMessage, result: ReadResult) -> Message | None:
    """None: a channel that has none of our messages, or a message of another version."""
    decode = _DECODERS.get(channel.topic)
    if decode is None:
        return None
    try:
        return decode(record.data)
    except msgspec.MsgspecError:
        result.undecodable += 1
        return None


@dataclass(frozen=True)
class FrameImage:
    """A frame at full size. ``data``: content of an image file of ``image_format``, "jpeg" or "png"."""

    frame_id: int
    image_format: str
    data: bytes


def read_with_images(path: Path, result: ReadResult | None = None) -> Iterator[Message | FrameImage]:
    """Yields messages and frames at full size in the order of the record."""
    result = ReadResult() if result is None else result
    for channel, record in _records(path, result):
        if channel.topic == IMAGE_TOPIC:
            with suppress(*_DAMAGED_IMAGE):
                yield FrameImage(*decode_image(record.data))
            continue
        message = _message(channel, record, result)
        if message is not None:
            yield message


def read_thumbnails(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yields (frame id, JPEG) in the order of the record."""
    for frame_id, _, data in _images(path, THUMBNAIL_TOPIC):
        yield frame_id, data


def read_frame_images(path: Path) -> Iterator[FrameImage]:
    """Yields the frames at full size, in the order of the record."""
    for found in _images(path, IMAGE_TOPIC):
        yield FrameImage(*found)


def _images(path: Path, topic: str) -> Iterator[tuple[int, str, bytes]]:
    for channel, record in _records(path, ReadResult()):
        if channel.topic == topic:
            with suppress(*_DAMAGED_IMAGE):
                yield decode_image(record.data)


def read_with_thumbnails(path: Path, kinds: Collection[type[Message]]) -> Iterator[Message | tuple[int, bytes]]:
    """Yields the messages of some types, and all thumbnails as (frame id, JPEG), in the order of the record."""
    topics = {topic_of(kind) for kind in kinds}
    for channel, record in _records(path, ReadResult()):
        with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
            if channel.topic == THUMBNAIL_TOPIC:
                frame_id, _, jpeg = decode_image(record.data)
                yield frame_id, jpeg
            elif channel.topic in topics:
                yield _DECODERS[channel.topic](record.data)


def _records(path: Path, result: ReadResult) -> Iterator[tuple[Channel, McapMessage]]:
    for file in flight_files(path):
        result.files.append(file)
        with file.open("rb") as stream:
            yield from _records_of(file, stream, result)


def _records_of(file: Path, stream: IO[bytes], result: ReadResult) -> Iterator[tuple[Channel, McapMessage]]:
    """Reads sequentially, because the index is at the end of the file, which a truncated file lacks."""
    channels: dict[int, Channel] = {}
    first = True
    for record in _contents(file, stream, result):
        if isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Metadata) and record.name == HEADER_NAME:
            result.header = result.header or _header(record.metadata)
        elif isinstance(record, Metadata) and record.name == CALIBRATION_NAME:
            result.header.setdefault("calibration", _decoded(record.metadata.get("camera", "{}")))
        elif isinstance(record, Metadata) and record.name == SOURCE_NAME:
            result.header.setdefault("source", _decoded(record.metadata.get("facts", "[]")))
        elif isinstance(record, McapMessage) and record.channel_id in channels:
            if first:
                result.segment_starts_ns.append(record.publish_time)
                first = False
            yield channels[record.channel_id], record


def _header(metadata: dict[str, str]) -> dict[str, Any]:
    parts = {name: _decoded(text) for name, text in metadata.items() if name != "format"}
    return {"config": {}, "versions": {}, **parts, "format": metadata.get("format", "")}


def _decoded(text: str) -> Any:
    """{} where the text is damaged: metadata records of MCAP have no checksum."""
    try:
        return msgspec.json.decode(text)
    except msgspec.DecodeError:
        return {}


def _contents(file: Path, stream: IO[bytes], result: ReadResult) -> Iterator[McapRecord]:
    """Yields the records of a file that matter here. A part that does not agree with its checksum or cannot be parsed
    is left out whole and named in ``result``; the parts after it are read. A chunk whose opcode is damaged is missed in
    the statistics at the end of the file: an opcode has no checksum."""
    chunks = 0
    try:
        for offset, opcode, content in _framed(stream):
            chunks += opcode == Opcode.CHUNK
            try:
                if opcode == Opcode.STATISTICS:
                    written = Statistics.read(ReadDataStream(BytesIO(content))).chunk_count
                    if written != chunks:
                        result.damaged.append(f"{file.name}: {chunks} of {written} chunks can be recognised")
                yield from _parse(opcode, content)
            except _CORRUPT as error:
                result.damaged.append(f"{file.name}, byte {offset}: {error or type(error).__name__}")
    except _CORRUPT:
        result.truncated_files.append(file)  # ends within a record, or has a length that cannot be


def _framed(stream: IO[bytes]) -> Iterator[tuple[int, int, bytes]]:
    """Yields (offset in the file, opcode, content) up to the footer. Raises EndOfFile or another McapError."""
    magic = stream.read(len(MCAP0_MAGIC))
    if magic != MCAP0_MAGIC:
        raise InvalidMagic(magic)
    opcode = 0
    while opcode != Opcode.FOOTER:
        offset = stream.tell()
        head = stream.read(_FRAMING.size)
        if len(head) < _FRAMING.size:
            raise EndOfFile
        opcode, length = _FRAMING.unpack(head)
        if length > _RECORD_LIMIT_BYTES or (opcode == Opcode.FOOTER and length != _FOOTER_BYTES):
            raise McapError(f"a record of {length} bytes")
        content = stream.read(length)
        if len(content) < length:
            raise EndOfFile
        yield offset, opcode, content


def _parse(opcode: int, content: bytes) -> list[McapRecord]:
    """-> metadata, channels and messages in a record of a file; index, statistics and schemas are not needed.

    Raises one of _CORRUPT."""
    if opcode == Opcode.METADATA:
        return [Metadata.read(ReadDataStream(BytesIO(content)))]
    if opcode == Opcode.CHUNK:
        chunk = Chunk.read(ReadDataStream(BytesIO(content)))
        # Sizes are checked before the memory is allocated.
        if chunk.compression == "zstd" and zstandard.frame_content_size(chunk.data) > _RECORD_LIMIT_BYTES:
            raise McapError("the size of the chunk is damaged")
        if chunk.uncompressed_size > _RECORD_LIMIT_BYTES or chunk.uncompressed_crc == 0:
            raise McapError("the head of the chunk is damaged")
        return breakup_chunk(chunk, validate_crc=True)
    return []
