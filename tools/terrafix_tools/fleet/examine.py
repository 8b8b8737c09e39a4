"""Reads one record into the tables of its flights; runs in the worker processes."""

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import msgspec
import pyarrow

import terrafix
from terrafix.core.errors import SourceError, TerrafixError
from terrafix.messages import Origin
from terrafix.recorder.reader import ReadResult, check_format, flight_files, read_received
from terrafix_tools.fleet.find import Place, Record, first_line
from terrafix_tools.fleet.flight import flight_id, flight_rows
from terrafix_tools.fleet.tables import FLIGHTS, FRAMES, UNKNOWN_DATE, to_parquet
from terrafix_tools.log.contents import damage_of
from terrafix_tools.parallel.pool import Workload

# Of a record whose header or times are damaged beyond what checksums cover, or that vanishes or cannot be read.
_UNREADABLE = (TerrafixError, OSError, ArithmeticError, ValueError, LookupError, TypeError, msgspec.MsgspecError)


@dataclass(frozen=True)
class FlightTables:
    """One flight. Of two records of it the one with the larger ``rank`` is kept: a live one, with more messages."""

    flight: str
    date: str  # of the start, YYYY-MM-DD or UNKNOWN_DATE
    rank: tuple[bool, int]
    flights: bytes  # Parquet
    frames: bytes  # Parquet


@dataclass(frozen=True)
class Examined:
    record: Record
    flights: tuple[FlightTables, ...] = ()
    error: str | None = None


class WorkerDied(SourceError):
    """A worker process ended while it read a record."""


class Examiner:
    """Implements ``Renderer``: reads records of a place, one after the other."""

    def __init__(self, place: Place) -> None:
        self._place = place

    def render(self, wanted: Record) -> Examined:
        flights: list[FlightTables] = []
        path = Path(wanted.path)
        try:
            with _on_disk(self._place, wanted) as path:
                for identified in _flights(path):
                    flights.append(_flight(identified, wanted))  # those before an error are kept
        except _UNREADABLE as error:
            return Examined(wanted, tuple(flights), _reason(error).removeprefix(f"{path}: "))
        return Examined(wanted, tuple(flights))


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, TerrafixError):
        return first_line(error)
    return f"its head or its times are damaged ({first_line(error) or type(error).__name__})"


@contextlib.contextmanager
def _on_disk(place: Place, record: Record) -> Iterator[Path]:
    """-> the record as a file or folder of this computer; one of a bucket is copied for as long as it is read."""
    if place.local:
        path = Path(record.folder) if record.run else Path(record.folder) / record.names[0]
        path.stat()  # raises OSError for a link without its file
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="terrafix-fleet-") as scratch:
        for name in record.names:
            with (
                place.files.open_input_stream(f"{record.folder}/{name}") as source,
                (Path(scratch) / name).open("wb") as copy,
            ):
                while block := source.read(1 << 20):
                    copy.write(block)
        yield Path(scratch) if record.run else Path(scratch) / record.names[0]


@dataclass(frozen=True)
class _Identified:
    path: Path  # a file, or a folder with the files of one flight
    summaries: Path  # folder of the summary of a replay
    flight: str


def _flights(path: Path) -> Iterator[_Identified]:
    """-> the flights of a record: a run folder has several when several runs were recorded into it. A file without an
    origin (cut off at its beginning) belongs to the flight of the file before it.

    Raises SourceError: no file has an origin."""
    summaries = path if path.is_dir() else path.parent / "none"
    identified: list[tuple[Path, str]] = []
    damage: list[str] = []
    first = None
    for file in flight_files(path):
        result = ReadResult()
        origin = next((m for _, _, _, m in read_received(file, result) if isinstance(m, Origin)), None)
        first = first or result
        damage += damage_of(result)
        stated = bool(result.header.get("config") and result.header.get("versions"))  # else the head is damaged
        found = flight_id(result.header, origin) if origin is not None and stated else ""
        identified.append((file, found or (identified[-1][1] if identified else "")))
    named = [flight for _, flight in identified if flight]
    if not named:
        check_format(path, first or ReadResult())
        reason = (
            f"what is readable has no origin ({damage[0]})" if damage else "the source of the flight was not opened"
        )
        raise SourceError(f"{path}: no flight in the record, {reason}")
    groups = [
        (flight, [file for file, _ in files]) for flight, files in groupby(identified, lambda item: item[1] or named[0])
    ]
    if len(groups) == 1:
        yield _Identified(path, summaries, named[0])
        return
    for flight, files in groups:
        with tempfile.TemporaryDirectory(prefix="terrafix-fleet-") as scratch:
            for file in files:
                (Path(scratch) / file.name).symlink_to(file.absolute())
            yield _Identified(Path(scratch), summaries, flight)


def _flight(identified: _Identified, record: Record) -> FlightTables:
    row, frames = flight_rows(identified.path, identified.summaries)
    start = row["start_utc"]
    return FlightTables(
        flight=identified.flight,
        date=UNKNOWN_DATE if start is None else f"{start:%Y-%m-%d}",
        rank=(row["live"], row["messages"]),
        flights=to_parquet(FLIGHTS, [row | {"record": record.path}]),
        frames=to_parquet(FRAMES, frames),
    )


@contextlib.contextmanager
def _environment(workers: int) -> Iterator[None]:
    """One thread of Arrow, because there is one process per core."""
    pyarrow.set_cpu_count(1)
    yield


def _built_with() -> str:
    return f"terrafix {terrafix.__version__}, pyarrow {pyarrow.__version__}"


FLEET_BUILD = Workload(
    name="terrafix-fleet-build",
    module="terrafix_tools.fleet.examine",
    environment=_environment,
    built_with=_built_with,
    error=SourceError,
    died=WorkerDied,
    again="build again",
)
