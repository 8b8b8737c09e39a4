"""GoPro's telemetry in an MP4 (GPMF): which streams a video has, and the positions of its GNSS receiver.

Reference: gopro/gpmf-parser, README. A track of format 'gpmd' has one payload for each second or so: keys of four
letters, type, size, number, value, nested where the type is 0. Positions are truth alone. Inertial streams and the
orientation are not read: the reference does not state their axes for each camera."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import SEEK_END
from pathlib import Path
from typing import BinaryIO, NamedTuple

from terrafix.core.errors import SourceError
from terrafix.vision.sources.positions import Fix

MAX_MOOV_BYTES = 256 * 1024 * 1024  # index of a video of hours
MAX_PAYLOADS = 100_000  # of a track, one a second
NUMBERS = {"b": "b", "B": "B", "s": "h", "S": "H", "l": "i", "L": "I", "f": "f", "d": "d", "j": "q", "J": "Q"}
FIELDS = {"GPS5": 5, "GPS9": 9}  # numbers of a fix
DEPTH = 4  # of the tables of a track: trak, mdia, minf, stbl
LOCKED = (2, 3)  # GPSF, and the last field of GPS9: fix in two or three dimensions
_CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl"}


class Payload(NamedTuple):
    """Part of the file, and when it begins and how long it lasts in the video [s]."""

    offset: int
    size: int
    t_s: float
    duration_s: float


@dataclass
class GoProTelemetry:
    device: str = ""
    streams: set[str] = field(default_factory=set)  # keys of the streams
    fixes: list[Fix] = field(default_factory=list)


def read_gpmf(path: Path) -> GoProTelemetry | None:
    """None: a video without such a track, or no MP4. What is damaged is left out. Raises SourceError: unreadable."""
    try:
        with path.open("rb") as file:
            length = file.seek(0, SEEK_END)
            payloads = _payloads(_moov(file, length))
            if payloads is None:
                return None
            found = GoProTelemetry()
            for payload in payloads[:MAX_PAYLOADS]:
                if payload.offset + payload.size <= length:
                    file.seek(payload.offset)
                    _take(found, file.read(payload.size), payload)
            return found
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror})") from None


# --- MP4 (ISO 14496-12) -----------------------------------------------------------------------------------------------


def _moov(file: BinaryIO, length: int) -> bytes:
    """The index of the file; empty without one."""
    offset = 0
    while offset < length:
        file.seek(offset)
        head = file.read(16)
        if len(head) < 8:
            return b""
        size, kind = struct.unpack_from(">I4s", head)
        begin = 8
        if size == 1 and len(head) == 16:
            size, begin = struct.unpack_from(">Q", head, 8)[0], 16
        if kind == b"moov" and begin <= size <= MAX_MOOV_BYTES:
            file.seek(offset + begin)
            return file.read(min(size, length - offset) - begin)
        if size < begin:  # 0: to the end of the file
            return b""
        offset += size
    return b""


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """(type, content) of the boxes in ``data``."""
    at = 0
    while at + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        begin = 8
        if size == 1 and at + 16 <= len(data):
            size, begin = struct.unpack_from(">Q", data, at + 8)[0], 16
        if size < begin:
            return
        yield kind, data[at + begin : at + size]
        at += size


def _tables(data: bytes, depth: int = DEPTH) -> dict[bytes, bytes]:
    """The boxes of a track by type, those of its containers, too."""
    found: dict[bytes, bytes] = {}
    for kind, content in _boxes(data):
        if kind in _CONTAINERS and depth:
            found |= _tables(content, depth - 1)
        else:
            found.setdefault(kind, content)
    return found


def _payloads(moov: bytes) -> list[Payload] | None:
    """Of the track of format 'gpmd'; None: there is none."""
    for kind, content in _boxes(moov):
        if kind != b"trak":
            continue
        tables = _tables(content)
        if tables.get(b"stsd", b"")[12:16] == b"gpmd":
            return list(_samples(tables))
    return None


def _samples(tables: dict[bytes, bytes]) -> Iterator[Payload]:
    head = tables.get(b"mdhd", b"")
    at = 20 if head[:1] == b"\x01" else 12
    scale = float(struct.unpack_from(">I", head.ljust(at + 4, b"\0"), at)[0]) or 1.0
    sizes = tables.get(b"stsz", b"").ljust(12, b"\0")
    one_size, count = struct.unpack_from(">II", sizes, 4)
    count = min(count, MAX_PAYLOADS)
    each = iter([one_size] * count if one_size else [row[0] for row in _rows(sizes[8:], ">I")])
    wide = b"co64" in tables
    chunks = [row[0] for row in _rows(tables.get(b"co64" if wide else b"stco", b"")[4:], ">Q" if wide else ">I")]
    runs = list(_rows(tables.get(b"stsc", b"")[4:], ">III")) or [(1, 1, 1)]
    durations = _durations(tables)
    t = 0
    for number, chunk in enumerate(chunks, start=1):
        in_chunk = next((run[1] for run in reversed(runs) if run[0] <= number), 1)
        offset = chunk
        for _ in range(min(in_chunk, count)):
            size = next(each, None)
            if size is None:
                return
            duration = next(durations, 0)
            yield Payload(offset, size, t / scale, duration / scale)
            offset, t = offset + size, t + duration


def _durations(tables: dict[bytes, bytes]) -> Iterator[int]:
    for count, delta in _rows(tables.get(b"stts", b"")[4:], ">II"):
        for _ in range(min(count, MAX_PAYLOADS)):
            yield delta


def _rows(data: bytes, form: str) -> Iterator[tuple[int, ...]]:
    """Rows of a table that begins with their number."""
    if len(data) < 4:
        return
    count = struct.unpack_from(">I", data)[0]
    size = struct.calcsize(form)
    for k in range(min(count, (len(data) - 4) // size)):
        yield struct.unpack_from(form, data, 4 + k * size)


# --- GPMF -------------------------------------------------------------------------------------------------------------


class _Item(NamedTuple):
    key: str
    kind: str  # type of the values; "\0": nested
    size: int  # of one value or structure
    values: bytes


def _items(data: bytes) -> Iterator[_Item]:
    at = 0
    while at + 8 <= len(data):
        key, kind, size, count = struct.unpack_from(">4sBBH", data, at)
        length = size * count
        yield _Item(key.decode("latin-1"), chr(kind), size, data[at + 8 : at + 8 + length])
        at += 8 + (length + 3) // 4 * 4


def _take(found: GoProTelemetry, data: bytes, payload: Payload) -> None:
    for device in _items(data):
        if device.key != "DEVC":
            continue
        for item in _items(device.values):
            if item.key == "DVNM":
                found.device = item.values.decode("latin-1").strip("\0 ")
            elif item.key == "STRM":
                stream = list(_items(item.values))
                if stream:
                    found.streams.add(stream[-1].key)
                    found.fixes += _fixes(stream, payload)


def _fixes(stream: list[_Item], payload: Payload) -> Iterator[Fix]:
    """Of a stream GPS5 or GPS9, spread evenly over its payload."""
    of = {item.key: item for item in stream}
    last = stream[-1]
    types = of["TYPE"].values.decode("latin-1") if last.kind == "?" and "TYPE" in of else last.kind * 5
    form = ">" + "".join(NUMBERS.get(one, "") for one in types)
    rows = len(last.values) // last.size if last.size else 0
    if len(types) != FIELDS.get(last.key) or struct.calcsize(form) != last.size or not rows:
        return
    scales = _numbers(of.get("SCAL"))
    scales = scales * len(types) if len(scales) == 1 else scales
    locked = last.key == "GPS9" or next(iter(_numbers(of.get("GPSF"))), 0) in LOCKED
    if len(scales) != len(types) or not all(scales) or not locked:
        return
    for k in range(rows):
        values = struct.unpack_from(form, last.values, k * last.size)
        lat_deg, lon_deg = values[0] / scales[0], values[1] / scales[1]
        if last.key == "GPS9" and values[-1] / scales[-1] not in LOCKED:
            continue
        if abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0 and (lat_deg, lon_deg) != (0.0, 0.0):
            yield round((payload.t_s + payload.duration_s * k / rows) * 1e9), lat_deg, lon_deg


def _numbers(item: _Item | None) -> list[float]:
    """The values of one of the plain types."""
    form = NUMBERS.get(item.kind, "") if item is not None else ""
    if item is None or not form:
        return []
    count = len(item.values) // struct.calcsize(form)
    return [float(value) for value in struct.unpack_from(f">{count}{form}", item.values)]
