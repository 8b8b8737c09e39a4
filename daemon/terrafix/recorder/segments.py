"""Ring of record files: a new file every few minutes, within a disk budget and above a floor of free space.

Nothing here raises in flight: what cannot be written is counted, and the record continues when the disk does."""

import re
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from terrafix.core import logs
from terrafix.core.errors import OutputError
from terrafix.messages import Message, Origin, SourceFacts
from terrafix.recorder.reader import flight_files
from terrafix.recorder.writer import FlightWriter

SEGMENT_BYTES = 64 * 1024 * 1024  # fast to open in a viewer; a lost segment costs minutes of the flight
SEGMENT_NS = 300 * 1_000_000_000
SEGMENTS_IN_BUDGET = 8  # least number of segments in the budget, so that deleting one leaves most of the record
FLOOR_BYTES = 256 * 1024 * 1024  # free space that the record leaves on the disk for logs and swap ...
FLOOR_SHARE = 0.1  # ... on a small disk this share of it
MEGABYTE = 1_000_000
FSYNC_S = 1.0  # a power cut loses this much, and what is written between two flushes (node.py)
RETRY_S = 5.0  # interval of attempts to write again
AT_FLOOR = "the free space of the disk is at its floor"
PROTECTED = "KEEP"  # a file of this name in a run folder keeps its records from being deleted
FRAME_IMAGE = "frame image"  # name of a frame at full size among what was lost
BOOT_ID = re.compile(r"[0-9a-f]{32}")  # name of the run folders that the systemd unit makes (%b)


class SegmentRing:
    """Writes flight-000.mcap, flight-001.mcap, ..., continuing after the last existing number.

    Run folders of the systemd unit, which lie beside each other, share one budget. Raises OutputError when the folder
    cannot be created because of its path or permissions; a disk that is full, read-only or gone is no error."""

    def __init__(
        self,
        folder: Path,
        header_metadata: dict[str, str],
        budget_mb: int,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._folder = folder
        self._header = header_metadata
        self._budget_bytes = budget_mb * MEGABYTE
        self._segment_bytes = min(SEGMENT_BYTES, self._budget_bytes // SEGMENTS_IN_BUDGET)
        self._clock_s = clock_s
        self._synced_s = clock_s()
        self._tried_s = clock_s() - RETRY_S
        self._writer: FlightWriter | None = None
        self._opened_ns: int | None = None
        # Written at the start of every segment, so that each segment can be evaluated when earlier ones are deleted.
        self._repeated: dict[str, Message] = {}
        self._lost: Counter[str] = Counter()
        self._unflushed: Counter[str] = Counter()  # lost with the chunk that they are in, if the disk does not take it
        self._blocked = ""  # reason why nothing is written
        self._sync: threading.Thread | None = None  # the last synchronisation with the disk
        self._sync_error: OSError | None = None  # of the present file
        _make_folder(folder)
        self._open()

    @property
    def blocked(self) -> str:
        """Why nothing is written at present; empty while the record is written."""
        return self._blocked

    def write(self, message: Message, received_ns: int) -> None:
        """``received_ns``: time of reception at the recorder."""
        if self._opened_ns is None:
            self._opened_ns = received_ns
        if isinstance(message, (Origin, SourceFacts)):
            self._repeated[type(message).__name__] = message
        if self._writer is None and self._clock_s() - self._tried_s >= RETRY_S:
            self._open()
        if self._writer is None:
            self._lost[type(message).__name__] += 1
            return
        try:
            self._unflushed[type(message).__name__] += 1
            self._writer.write(message, received_ns)
        except OSError as error:
            self._block(error.strerror or str(error))
            return
        if self._writer.size_bytes() > self._segment_bytes or received_ns - self._opened_ns > SEGMENT_NS:
            self._next(received_ns)

    def write_thumbnail(self, t_ns: int, frame_id: int, jpeg: bytes) -> None:
        self._write_image("thumbnail", lambda writer: writer.write_thumbnail(t_ns, frame_id, jpeg))

    def write_frame_image(self, t_ns: int, frame_id: int, data: bytes, image_format: str) -> None:
        self._write_image(FRAME_IMAGE, lambda writer: writer.write_frame_image(t_ns, frame_id, data, image_format))

    def count_lost(self, name: str) -> None:
        """Something of this ``name`` cannot be recorded."""
        self._lost[name] += 1

    def _write_image(self, name: str, write: Callable[[FlightWriter], None]) -> None:
        if self._writer is None:
            self._lost[name] += 1
            return
        try:
            self._unflushed[name] += 1
            write(self._writer)
        except OSError as error:
            self._block(error.strerror or str(error))

    def take_lost(self) -> Counter[str]:
        """-> number of messages by type that were not written since the last call, once they can be recorded. Of the
        time since the last flush before a disk failed all are counted, although some may be in the file."""
        if self._writer is None:
            return Counter()
        lost, self._lost = self._lost, Counter()
        return lost

    def flush(self) -> None:
        """Passes all data to the operating system, every FSYNC_S to the disk, and watches the free space."""
        if self._writer is None:
            return
        try:
            if self._sync_error is not None:
                raise self._sync_error
            self._writer.flush()
            self._unflushed.clear()
            if self._clock_s() - self._synced_s >= FSYNC_S:
                self._begin_sync(self._writer)
            if self._below_floor():
                self._make_room()
                if self._below_floor():
                    self._block(AT_FLOOR)
        except OSError as error:
            self._block(error.strerror or str(error))

    def close(self) -> None:
        self._close_writer()

    def _begin_sync(self, writer: FlightWriter) -> None:
        """Passes what was flushed to the disk, in a thread of its own: a disk that stalls for seconds must not keep
        later messages from the operating system, from which a kill does not take them."""
        if self._sync is not None and self._sync.is_alive():
            return
        self._synced_s = self._clock_s()
        self._sync = threading.Thread(target=self._sync_file, args=(writer,), name="recorder-sync", daemon=True)
        self._sync.start()

    def _sync_file(self, writer: FlightWriter) -> None:
        try:
            writer.sync()
        except OSError as error:
            if writer is self._writer:
                self._sync_error = error
        except ValueError:  # the file was closed before
            return

    def _block(self, reason: str) -> None:
        """Ends the present segment. The flight goes on without a record until the disk takes one again."""
        self._lost += self._unflushed
        self._unflushed.clear()
        self._close_writer()
        self._tried_s = self._clock_s()
        if not self._blocked:
            logs.get().error(
                "recording stopped", reason=reason, folder=str(self._folder), todo="make room, or check the disk"
            )
        self._blocked = reason

    def _close_writer(self) -> None:
        """What the disk does not take at the end of a file is counted as lost."""
        writer, self._writer = self._writer, None
        self._sync_error = None
        if writer is None:
            return
        try:
            writer.close()
        except OSError:
            self._lost += self._unflushed
        self._unflushed.clear()

    def _next(self, received_ns: int) -> None:
        self._close_writer()
        self._open()
        self._opened_ns = received_ns

    def _open(self) -> None:
        """Opens the next segment, or blocks."""
        self._tried_s = self._clock_s()
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._make_room()
            if self._below_floor():
                self._block(AT_FLOOR)
                return
            number = 1 + max((int(path.stem.split("-")[1]) for path in _segments(self._folder)), default=-1)
            self._writer = self._new_file(self._folder / f"flight-{number:03d}.mcap")
            for message in self._repeated.values():
                self._writer.write(message, message.t_ns)
        except (OSError, OutputError) as error:
            self._block(str(error))
            return
        if self._blocked:
            logs.get().warning("recording continues", file=self._writer.path.name)
            self._blocked = ""

    def _new_file(self, path: Path) -> FlightWriter:
        try:
            return FlightWriter(path, self._header)
        except OSError:
            _delete(path)  # a full disk may take the file and not its head; the next attempt makes another one
            raise

    def _below_floor(self) -> bool:
        usage = shutil.disk_usage(self._folder)
        return usage.free < min(FLOOR_BYTES, FLOOR_SHARE * usage.total)

    def _make_room(self) -> None:
        """Deletes the oldest segments of other flights until another one fits into the budget and above the floor, then
        the oldest of this flight, if its own budget asks for it: free space alone never costs this flight's record."""
        own, others = _segments(self._folder), self._segments_of_others()
        sizes = {path: _size(path) for path in (*own, *others)}
        used = sum(sizes.values())
        while others and (used + self._segment_bytes > self._budget_bytes or self._below_floor()):
            used -= sizes[others[0]]
            _delete(others.pop(0))
        while own and used + self._segment_bytes > self._budget_bytes:
            used -= sizes[own[0]]
            _delete(own.pop(0))

    def _segments_of_others(self) -> list[Path]:
        """Segments of the other run folders that share the budget, oldest first, without those that are protected."""
        if not BOOT_ID.fullmatch(self._folder.name):
            return []
        folders = [
            folder
            for folder in self._folder.parent.iterdir()
            if BOOT_ID.fullmatch(folder.name) and folder != self._folder and not (folder / PROTECTED).exists()
        ]
        segments = [path for folder in folders for path in _segments(folder)]
        return sorted(segments, key=lambda path: (_modified(path), path))


def _make_folder(folder: Path) -> None:
    """Raises OutputError for a path on which no folder can be, and for missing permissions."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError, PermissionError) as error:
        raise OutputError(f"{folder}: cannot be made ({error.strerror}); check the folder given to --out") from None
    except OSError:
        return  # full, read-only or gone: tried again


def _segments(folder: Path) -> list[Path]:
    """Segments of a run folder, oldest first."""
    if not any(folder.glob("flight-*.mcap")):
        return []
    return [path for path in flight_files(folder) if not path.name.startswith("flight.mcap")]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _modified(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _delete(path: Path) -> None:
    with suppress(OSError):
        path.unlink()
