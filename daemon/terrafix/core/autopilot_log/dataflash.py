"""Reads ArduPilot's DataFlash logs, binary (.bin) and text (.log), into one table for each message type.

Binary: messages of 0xA3 0x95, type, fields; a message FMT (type 128) states length, name, format characters and column
names of a type (AP_Logger/LogStructure.h). Text: the same messages as lines "NAME, value, ...". A whole type is
converted at once, so that a log of an hour takes a second. The reader of pymavlink (DFReader) takes twenty times as
long and is under the GPL; a test compares both."""

import re
import struct
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from terrafix.core.autopilot_log.attitude import AttitudeSeries, cleaned

HEAD = b"\xa3\x95"
FMT_TYPE, FMT_LENGTH = 128, 89
_FMT = struct.Struct("<BB4s16s64s")
# Format character -> numpy type and divisor (LogStructure.h). Logs from 2021 on state further factors in FMTU and MULT;
# of the columns read here they matter for the test ratios alone (``Table.hundredths``).
_CHARACTERS: dict[str, tuple[str, float]] = {
    "a": ("<i2", 1.0),  # 32 of them
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "g": ("<f2", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "f": ("<f4", 1.0),
    "d": ("<f8", 1.0),
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "Z": ("S64", 1.0),
    "c": ("<i2", 1e2),
    "C": ("<u2", 1e2),
    "e": ("<i4", 1e2),
    "E": ("<u4", 1e2),
    "L": ("<i4", 1e7),
    "M": ("u1", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
}
_ARRAY = 32  # elements of "a"


@dataclass(frozen=True)
class Format:
    name: str
    characters: str
    columns: tuple[str, ...]

    def dtype(self) -> np.dtype:
        """Of a message without its head. Raises KeyError for a character that is not known."""
        shapes = [(f"c{i}", _CHARACTERS[c][0], (_ARRAY,) if c == "a" else ()) for i, c in enumerate(self.characters)]
        return np.dtype(shapes)


@dataclass(frozen=True)
class Table:
    """All messages of one type. ``order`` (N,): where each is in the file. ``t_s`` (N,): seconds since the start of the
    autopilot; of messages without a time that of the last message before them that has one."""

    columns: dict[str, np.ndarray]  # numbers as float64, texts as str
    characters: dict[str, str]  # format character of each column
    order: np.ndarray
    t_s: np.ndarray

    def __len__(self) -> int:
        return len(self.order)

    def has(self, *names: str) -> bool:
        return all(name in self.columns for name in names)

    def column(self, name: str, missing: float = np.nan) -> np.ndarray:
        """The numbers of a column; ``missing`` where the log has no such column, or texts in it (a damaged FMT)."""
        known = name in self.columns and self.columns[name].dtype != object
        return self.columns[name] if known else np.full(len(self), missing)

    def texts(self, name: str) -> list[str]:
        """The texts of a column; empty ones where the log has no such column."""
        return [str(text) for text in self.columns[name]] if name in self.columns else [""] * len(self)

    def integers(self, name: str) -> np.ndarray:
        """Whole numbers; 0 where they are missing or damaged."""
        return np.nan_to_num(self.column(name, 0.0)).astype(np.int64)

    def hundredths(self, name: str) -> np.ndarray:
        """A column that is logged in hundredths: as "c" in old logs, as "H" with a factor of its own in newer ones."""
        return self.column(name) * (0.01 if self.characters.get(name) == "H" else 1.0)

    def by_instance(self, *names: str) -> dict[int, "Table"]:
        """The messages of each instance (core, receiver), by the first column of ``names`` that there is; 0: none."""
        key = next((name for name in names if name in self.columns and self.columns[name].dtype != object), None)
        if key is None:
            return {0: self} if len(self) else {}
        return {int(i): self.of(self.columns[key] == i) for i in np.unique(self.columns[key]) if np.isfinite(i)}

    def of(self, keep: np.ndarray) -> "Table":
        """The messages that ``keep`` (N,) bool selects."""
        columns = {name: values[keep] for name, values in self.columns.items()}
        return Table(columns, self.characters, self.order[keep], self.t_s[keep])


@dataclass(frozen=True)
class DataFlash:
    tables: dict[str, Table]
    counts: Counter[str]  # messages of all types in the file
    skipped_bytes: int


def attitude_of(att: Table) -> AttitudeSeries:
    """Of the messages ATT, whose angles are in degrees."""
    return cleaned(AttitudeSeries(att.t_s, *(np.radians(att.column(name)) for name in ("Roll", "Pitch", "Yaw"))))


def is_dataflash(head: bytes) -> bool:
    """Whether the first bytes of a file are those of a DataFlash log, binary or text. The first of them may be lost,
    zero or foreign: a whole message FMT is enough."""
    return _has_binary_format(head) or _has_text_format(head)


def read_dataflash(path: Path, wanted: Iterable[str]) -> DataFlash:
    """Reads the messages of the ``wanted`` types. Raises OSError."""
    data = path.read_bytes()
    return _read_binary(data, set(wanted)) if _has_binary_format(data) else _read_text(data, set(wanted))


def _has_binary_format(data: bytes) -> bool:
    """Whether a message FMT is in the data whose length is that of its format characters."""
    begin = HEAD + bytes([FMT_TYPE])
    at = data.find(begin)
    while at >= 0:
        if at + FMT_LENGTH <= len(data) and _stated_format(data, at) is not None:
            return True
        at = data.find(begin, at + 1)
    return False


def _has_text_format(data: bytes) -> bool:
    """Whether a line FMT is in the data with number and length of a message and known format characters."""
    for line in re.findall(rb"^FMT,[ \d]+,[ \d]+,[^\r\n]+", data, re.MULTILINE):
        cells = [cell.strip() for cell in line.decode("latin-1").split(",", 5)]
        if len(cells) == 6 and _format(cells[3], cells[4], cells[5].replace(" ", "")) is not None:
            return True
    return False


def _read_binary(data: bytes, wanted: set[str]) -> DataFlash:
    formats, offsets, skipped = _scan(data)
    counts = Counter({formats[kind].name: len(found) for kind, found in offsets.items()})
    raw = np.frombuffer(data, np.uint8)
    parts: dict[str, tuple[Format, dict[str, np.ndarray], np.ndarray]] = {}
    for kind, found in offsets.items():
        layout = formats[kind]
        if layout.name not in wanted:
            continue
        dtype, order = layout.dtype(), np.array(found)
        rows = np.empty((len(order), dtype.itemsize), np.uint8)
        for k in range(dtype.itemsize):
            rows[:, k] = raw[order + len(HEAD) + 1 + k]
        values = rows.view(dtype).ravel()
        columns = {
            name: _converted(values[f"c{i}"], layout.characters[i])
            for i, name in enumerate(layout.columns)
            if layout.characters[i] != "a"
        }
        parts[layout.name] = layout, columns, order
    return DataFlash(_tables(parts), counts, skipped)


def _scan(data: bytes) -> tuple[dict[int, Format], dict[int, list[int]], int]:
    """-> formats by type, offsets of the messages by type, bytes that belong to no message."""
    formats: dict[int, Format] = {}
    lengths = [0] * 256
    lengths[FMT_TYPE] = FMT_LENGTH
    offsets: defaultdict[int, list[int]] = defaultdict(list)
    at, size, skipped = 0, len(data), 0
    while at + 3 <= size:
        kind = data[at + 2]
        length = lengths[kind] if data[at] == HEAD[0] and data[at + 1] == HEAD[1] else 0
        if length == 0 or at + length > size:
            following = data.find(HEAD, at + 1)
            following = size if following < 0 else following
            skipped += following - at
            at = following
            continue
        if kind == FMT_TYPE:
            stated = _stated_format(data, at)
            if stated is not None:
                number, formats[number], lengths[number] = stated
        offsets[kind].append(at)
        at += length
    formats.setdefault(FMT_TYPE, Format("FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns")))
    return formats, dict(offsets), skipped + size - at


def _stated_format(data: bytes, at: int) -> tuple[int, Format, int] | None:
    """(type, format, length) that the message FMT at ``at`` states; None: not known, or of another length."""
    number, length, *texts = _FMT.unpack_from(data, at + 3)
    layout = _format(*(text.split(b"\0")[0].decode("latin-1") for text in texts))
    return (number, layout, length) if layout is not None and layout.dtype().itemsize + 3 == length else None


def _format(name: str, characters: str, columns: str) -> Format | None:
    """None: a format that is not known."""
    names = tuple(columns.split(",")) if columns else ()
    known = all(c in _CHARACTERS for c in characters) and len(names) == len(characters)
    return Format(name, characters, names) if known else None


def _converted(values: np.ndarray, character: str) -> np.ndarray:
    if values.dtype.kind == "S":
        return np.array([text.split(b"\0")[0].decode("utf-8", "replace") for text in values.tolist()], dtype=object)
    with np.errstate(invalid="ignore"):  # damaged bytes are any float
        return values.astype(np.float64) / _CHARACTERS[character][1]


def _read_text(data: bytes, wanted: set[str]) -> DataFlash:
    """Values in text are scaled already."""
    formats: dict[str, Format] = {}
    rows: defaultdict[str, list[list[str]]] = defaultdict(list)
    order: defaultdict[str, list[int]] = defaultdict(list)
    counts: Counter[str] = Counter()
    skipped = 0
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines()):
        name, _, rest = line.partition(",")
        name = name.strip()
        if name == "FMT":
            cells = [cell.strip() for cell in rest.split(",", 4)]
            layout = _format(cells[2], cells[3], cells[4].replace(" ", "")) if len(cells) == 5 else None
            if layout is not None:
                formats[layout.name] = layout
        elif name not in formats:
            skipped += len(line) + 1
            continue
        counts[name] += 1
        if name in wanted and name in formats:
            count = len(formats[name].columns)
            cells = [cell.strip() for cell in rest.split(",", count - 1)]
            if len(cells) == count:
                rows[name].append(cells)
                order[name].append(number)
            else:
                skipped += len(line) + 1
    parts: dict[str, tuple[Format, dict[str, np.ndarray], np.ndarray]] = {}
    for name, found in rows.items():
        columns = {
            column: _numbers([row[i] for row in found], formats[name].characters[i])
            for i, column in enumerate(formats[name].columns)
        }
        parts[name] = formats[name], columns, np.array(order[name])
    return DataFlash(_tables(parts), counts, skipped)


def _numbers(cells: list[str], character: str) -> np.ndarray:
    """Numbers, or texts where the column has texts ("n", "N", "Z", and "M" where it has the names of modes)."""
    if character in "nNZ" or (character == "M" and not all(cell.isdecimal() for cell in cells)):
        return np.array(cells, dtype=object)
    found = np.full(len(cells), np.nan)
    for i, cell in enumerate(cells):
        try:
            found[i] = float(cell)
        except ValueError:
            continue  # a damaged line
    return found


def _tables(parts: dict[str, tuple[Format, dict[str, np.ndarray], np.ndarray]]) -> dict[str, Table]:
    times = {name: _times(name, columns) for name, (_, columns, _) in parts.items()}
    timed = [(parts[name][2], t_s) for name, t_s in times.items() if t_s is not None]
    places = np.concatenate([order for order, _ in timed]) if timed else np.zeros(0)
    clock = np.concatenate([t_s for _, t_s in timed]) if timed else np.zeros(0)
    others_timed = any(t_s is not None for name, t_s in times.items() if name not in ("GPS", "GPS2"))
    by_place = np.argsort(places, kind="stable")
    places, clock = places[by_place], clock[by_place]
    tables = {}
    for name, (layout, columns, order) in parts.items():
        t_s = times[name]
        if t_s is None and not len(clock):
            t_s = np.full(len(order), np.nan)
        elif t_s is None and not others_timed:  # logs of 2013: the GPS alone has a time
            t_s = np.interp(order, places, clock)
        elif t_s is None:
            t_s = clock[np.maximum(np.searchsorted(places, order) - 1, 0)]
        tables[name] = Table(columns, dict(zip(layout.columns, layout.characters, strict=True)), order, t_s)
    return tables


def _times(name: str, columns: dict[str, np.ndarray]) -> np.ndarray | None:
    """Seconds since the start of the autopilot; None: the message has no time."""
    columns = {column: values for column, values in columns.items() if values.dtype != object}
    if "TimeUS" in columns:
        return columns["TimeUS"] * 1e-6
    if name in ("GPS", "GPS2"):  # in old logs TimeMS of a GPS is that of the GPS week, in those of 2013 Time, too
        for column in ("T", "Time"):
            if column in columns:
                return columns[column] * 1e-3
    return columns["TimeMS"] * 1e-3 if "TimeMS" in columns else None
