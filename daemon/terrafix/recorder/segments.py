"""Ring of record files: a new file every few minutes; the oldest is deleted when the disk budget is exceeded."""

import shutil
from pathlib import Path

from terrafix.core.errors import OutputError
from terrafix.messages import Message
from terrafix.recorder.reader import flight_files
from terrafix.recorder.writer import FlightWriter

SEGMENT_BYTES = 64 * 1024 * 1024  # fast to open in a viewer; a lost segment costs minutes of the flight
SEGMENT_NS = 300 * 1_000_000_000
SEGMENTS_IN_BUDGET = 8  # least number of segments in the budget, so that deleting one leaves most of the record
DISK_RESERVE_BYTES = 256 * 1024 * 1024  # free space that the record leaves on the disk for logs and swap
MEGABYTE = 1_000_000


class SegmentRing:
    """Writes flight-000.mcap, flight-001.mcap, ..., continuing after the last existing number.

    Raises OutputError when the folder or a file cannot be created."""

    def __init__(self, folder: Path, header_metadata: dict[str, str], budget_mb: int) -> None:
        self._folder = folder
        self._header = header_metadata
        self._budget_bytes = budget_mb * MEGABYTE
        self._segment_bytes = min(SEGMENT_BYTES, self._budget_bytes // SEGMENTS_IN_BUDGET)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"{folder}: cannot be made ({error.strerror}); check the folder given to --out") from None
        self._number = 1 + max((int(p.stem.split("-")[1]) for p in self._segments()), default=-1)
        self._writer = self._open()
        self._opened_ns: int | None = None
        # Written at the start of every segment, so that each segment can be evaluated when earlier ones are deleted.
        self._origin: Message | None = None

    def write(self, message: Message, received_ns: int) -> None:
        """``received_ns``: time of reception at the recorder."""
        if self._opened_ns is None:
            self._opened_ns = received_ns
        if type(message).__name__ == "Origin":
            self._origin = message
        self._writer.write(message, received_ns)
        if self._writer.size_bytes() > self._segment_bytes or received_ns - self._opened_ns > SEGMENT_NS:
            self._next(received_ns)

    def write_thumbnail(self, t_ns: int, frame_id: int, jpeg: bytes) -> None:
        self._writer.write_thumbnail(t_ns, frame_id, jpeg)

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()

    def _next(self, received_ns: int) -> None:
        self._writer.close()
        self._number += 1
        self._writer = self._open()
        self._opened_ns = received_ns
        if self._origin is not None:
            self._writer.write(self._origin, received_ns)

    def _open(self) -> FlightWriter:
        self._make_room()
        return FlightWriter(self._folder / f"flight-{self._number:03d}.mcap", self._header)

    def _make_room(self) -> None:
        """Deletes the oldest segments until another one fits into the budget and on the disk."""
        while segments := self._segments():
            used = sum(p.stat().st_size for p in segments)
            free = shutil.disk_usage(self._folder).free
            if used + self._segment_bytes <= self._budget_bytes and free > DISK_RESERVE_BYTES + self._segment_bytes:
                return
            segments[0].unlink()

    def _segments(self) -> list[Path]:
        if not any(self._folder.glob("flight-*.mcap")):
            return []
        return [p for p in flight_files(self._folder) if not p.name.startswith("flight.mcap")]
