"""The folder of a fleet: Parquet files by date and flight, and the list of the records that were read.

    flights/date=2026-07-03/flight=0123456789abcdef/part.parquet    one row
    frames/date=2026-07-03/flight=0123456789abcdef/part.parquet     one row a frame
    records.jsonl                                                   one line a record: size, time, flights or error

A file appears under its name when it is complete. The frames of a flight come first: its row among the flights makes
them visible. A record comes into the list after its flights."""

import fcntl
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import msgspec
import pyarrow
from pyarrow import parquet

from terrafix.core.errors import OutputError, SourceError
from terrafix_tools.fleet.examine import Examined
from terrafix_tools.fleet.find import Record
from terrafix_tools.fleet.tables import PART, TABLES

LIST = "records.jsonl"
LOCK = ".lock"
TEMPORARY = ".part"  # beginning of the names of unfinished files; readers of hive layouts leave out names with a dot


class Listed(msgspec.Struct, frozen=True):
    """A record that was read."""

    record: str  # path or address
    size: int
    modified_ns: int
    flights: list[str]
    error: str | None = None


@dataclass(frozen=True)
class Stored:
    date: str
    rank: tuple[bool, int]  # as in FlightTables


class FleetFolder:
    """A fleet that is being built; nobody else builds it at the same time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.listed = read_list(folder)
        self.flights = {flight: stored for flight, stored in self._stored()}
        self._list: IO[bytes] | None = None

    def is_known(self, record: Record) -> bool:
        """Whether the record was read in its present state, and its flights are there."""
        known = self.listed.get(record.path)
        if known is None or known.error is not None:
            return False
        same = (known.size, known.modified_ns) == (record.size, record.modified_ns)
        return same and all(flight in self.flights for flight in known.flights)

    def put(self, examined: Examined) -> tuple[int, int]:
        """Stores what was read of a record. -> numbers of flights that are new, and that have grown."""
        new = grown = 0
        for tables in examined.flights:
            before = self.flights.get(tables.flight)
            if before is not None and before.rank >= tables.rank:
                continue
            if before is not None and before.date != tables.date:  # the clock was corrected in flight
                self._remove(tables.flight, before.date)
            for name, content in (("frames", tables.frames), ("flights", tables.flights)):
                self._write(self._part(name, tables.date, tables.flight), content)
            self.flights[tables.flight] = Stored(tables.date, tables.rank)
            new, grown = (new + 1, grown) if before is None else (new, grown + 1)
        record = examined.record
        self._append(
            Listed(
                record.path,
                record.size,
                record.modified_ns,
                [tables.flight for tables in examined.flights],
                examined.error,
            )
        )
        return new, grown

    def forget(self, place: str, found: Iterable[Record]) -> None:
        """Takes records off the list that could not be read and are no longer below ``place``."""
        there = {record.path for record in found}
        gone = [
            path
            for path, known in self.listed.items()
            if known.error is not None and path not in there and (path == place or path.startswith(f"{place}/"))
        ]
        for path in gone:
            del self.listed[path]

    def finish(self) -> None:
        """Writes the list anew, one line a record."""
        self.close()
        lines = (msgspec.json.encode(self.listed[path]) + b"\n" for path in sorted(self.listed))
        self._write(self.folder / LIST, b"".join(lines))

    def close(self) -> None:
        if self._list is not None:
            self._list.close()
            self._list = None

    def _append(self, listed: Listed) -> None:
        self.listed[listed.record] = listed
        if self._list is None:
            self._list = (self.folder / LIST).open("ab")
            self._list.write(b"\n")  # ends a line that a kill has cut off
        self._list.write(msgspec.json.encode(listed) + b"\n")
        self._list.flush()

    def _part(self, table: str, date: str, flight: str) -> Path:
        return self.folder / table / f"date={date}" / f"flight={flight}" / PART

    def _write(self, path: Path, content: bytes) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f"{TEMPORARY}-{path.name}")
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)

    def _remove(self, flight: str, date: str) -> None:
        for table in ("flights", "frames"):
            shutil.rmtree(self._part(table, date, flight).parent, ignore_errors=True)

    def _stored(self) -> Iterator[tuple[str, Stored]]:
        """Flights that are there; one whose file cannot be read is built again."""
        for part in sorted((self.folder / "flights").glob(f"date=*/flight=*/{PART}")):
            flight, date = part.parent.name.partition("=")[2], part.parent.parent.name.partition("=")[2]
            with suppress(OSError, pyarrow.ArrowException):
                row = parquet.ParquetFile(part).read(columns=["live", "messages"]).to_pylist()[0]
                yield flight, Stored(date, (row["live"], row["messages"]))


@contextmanager
def open_fleet(folder: Path) -> Iterator[FleetFolder]:
    """The folder of a fleet to build, made when it is missing. Raises OutputError: it cannot be written, or another
    build has it."""
    try:
        for table in TABLES:  # also of a fleet without a readable record
            (folder / table).mkdir(parents=True, exist_ok=True)
        with (folder / LOCK).open("wb") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # ends with the process, also with a killed one
            except BlockingIOError:
                raise OutputError(f"{folder}: another build is writing this fleet; wait for its end") from None
            fleet = FleetFolder(folder)
            try:
                yield fleet
            finally:
                fleet.close()
    except OSError as error:
        raise OutputError(
            f"{folder}: cannot be written ({error.strerror or error}); check the folder given to --out, and its space"
        ) from None


def read_list(folder: Path) -> dict[str, Listed]:
    """-> records that were read, by path; of a record the last line counts. A line that was cut off is left out."""
    try:
        lines = (folder / LIST).read_bytes().splitlines()
    except FileNotFoundError:
        return {}
    decode = msgspec.json.Decoder(Listed).decode
    listed = {}
    for line in lines:
        with suppress(msgspec.DecodeError):
            one = decode(line)
            listed[one.record] = one
    return listed


def check_fleet(folder: Path) -> None:
    """Raises SourceError: the folder has no fleet."""
    if not all((folder / table).is_dir() for table in TABLES):
        raise SourceError(f"{folder}: no fleet here; make one with 'terrafix fleet build FOLDER --out {folder}'")
