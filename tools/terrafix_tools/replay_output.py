"""Output of a replay: rows, record and summary, under temporary names until the flight is over."""

import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

import numpy as np

from terrafix.core.config import RecorderSection
from terrafix.core.errors import OutputError
from terrafix.core.node import Image
from terrafix.messages import (
    CalibrationEstimate,
    CalibrationFault,
    Frame,
    MapMatch,
    MeasurementVerdict,
    Message,
    Odometry,
    Origin,
    Verdict,
)
from terrafix.recorder.images import ImagePolicy
from terrafix.recorder.reader import read_frame_images, read_thumbnails
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.estimates import ESTIMATES, NS, PARTIAL, RowTable, write_rows
from terrafix_tools.finalised import SUMMARY as FINALISED_SUMMARY
from terrafix_tools.finalised import TABLE as FINALISED_TABLE
from terrafix_tools.flight_verdict import flight_verdict
from terrafix_tools.lens_report import lens_words

RECORD, SUMMARY = "flight.mcap", "summary.json"
# Derived from the three files above: those of an earlier replay would be stale.
DERIVED = ("evaluation.json", "report.html", FINALISED_TABLE, FINALISED_SUMMARY)


class ReplayOutput:
    """A context manager. On an exception the partial files stay and are readable."""

    def __init__(self, out: Path, header: dict[str, str], recorder: RecorderSection) -> None:
        """``header``: of the record (``recorder.provenance``); ``recorder``: which images it has."""
        self._out = out
        self._header = header
        self._images = ImagePolicy(recorder)
        self._full_frames: set[int] = set()  # that are to be recorded at full size
        self._table = RowTable()
        self._verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
        self._matcher: Counter[str] = Counter()
        self._matched_by: Counter[str] = Counter()
        self._registered: dict[int, bool] = {}
        self._origin: Origin | None = None
        self._calibration: CalibrationEstimate | None = None
        self._faults: list[tuple[float, CalibrationFault]] = []

    def __enter__(self) -> Self:
        """Raises OutputError when the folder cannot be written."""
        try:
            self._out.mkdir(parents=True, exist_ok=True)
            for name in (ESTIMATES, RECORD, SUMMARY, *DERIVED):
                (self._out / name).unlink(missing_ok=True)
                (self._out / (name + PARTIAL)).unlink(missing_ok=True)
            self._csv: TextIO = (self._out / (ESTIMATES + PARTIAL)).open("w", encoding="utf-8", newline="")
        except OSError as error:
            where = f"{self._out}: cannot be written ({error.strerror})"
            raise OutputError(f"{where}; choose a folder that you may write with --out") from None
        write_rows(self._csv, [])
        self._record = FlightWriter(self._out / (RECORD + PARTIAL), self._header)
        return self

    def take(self, messages: list[Message]) -> None:
        with self._writing():
            for message in messages:
                self._record.write(message, message.t_ns)
                self._table.take(message)
                self._count(message)
                frame_id = self._images.full_frame(message)
                if frame_id is not None:
                    self._full_frames.add(frame_id)

    def frame_done(self, frame: Frame, image: Image | None, process_ms: float) -> None:
        """Writes the row of the frame to disk; its refined position follows in finish()."""
        row = self._table.rows[frame.frame_id]
        row.process_ms = process_ms
        with self._writing():
            if image is not None and self._images.thumbnails:
                self._record.write_thumbnail(frame.t_ns, frame.frame_id, self._images.thumbnail(image))
            if image is not None and frame.frame_id in self._full_frames:
                image_format = self._images.settings.frame_format
                self._record.write_frame_image(frame.t_ns, frame.frame_id, self._images.encoded(image), image_format)
                self._full_frames.discard(frame.frame_id)
            self._record.flush()
            write_rows(self._csv, [row], header=False)
            self._csv.flush()

    def copy_images(self, record: Path) -> None:
        """Adds the images that another record of this flight has of its frames so far."""
        with self._writing():
            for frame_id, jpeg in read_thumbnails(record):
                if frame_id not in self._table.rows:
                    continue
                self._record.write_thumbnail(self._time_ns(frame_id), frame_id, jpeg)
            for image in read_frame_images(record):
                if image.frame_id not in self._table.rows:
                    continue
                t_ns = self._time_ns(image.frame_id)
                self._record.write_frame_image(t_ns, image.frame_id, image.data, image.image_format)

    def _time_ns(self, frame_id: int) -> int:
        return round(self._table.rows[frame_id].t_s * NS)

    def counts(self, cause: str = "") -> dict[str, Any]:
        """Returns frames, verdicts and times for summary.json. ``cause``: of a flight that found nothing, if something
        else than its monitors has found it."""
        rows = list(self._table.rows.values())
        verdict = flight_verdict(rows, self._faults, self._verdicts)
        times_ms = [r.process_ms for r in rows if r.process_ms is not None]
        return {
            "frames": len(rows),
            "localised": sum(r.localised for r in rows),
            "refined": sum(r.refined_lat_deg is not None for r in rows),
            "odometry_frames": sum(self._registered.values()),
            "verdicts": {what: dict(sorted(c.items())) for what, c in sorted(self._verdicts.items())},
            "lens": lens_words(self._origin.camera, self._calibration) if self._origin and self._calibration else None,
            "verdict": (replace(verdict, cause=cause) if cause else verdict).as_json(),
            "matcher_verdicts": dict(sorted(self._matcher.items())),
            "matched_by": dict(sorted(self._matched_by.items())),
            "frame_ms_median": round(float(np.median(times_ms)), 1) if times_ms else None,
            "frame_ms_p95": round(float(np.percentile(times_ms, 95)), 1) if times_ms else None,
        }

    def finish(self, summary: dict[str, Any]) -> None:
        """Writes the refined rows and the summary, and renames all files to their final names."""
        with self._writing():
            self._csv.close()
            self._record.close()
            with (self._out / (ESTIMATES + PARTIAL)).open("w", encoding="utf-8", newline="") as stream:
                write_rows(stream, self._table.rows.values())
            text = json.dumps(summary, indent=2, allow_nan=False) + "\n"
            (self._out / (SUMMARY + PARTIAL)).write_text(text, encoding="utf-8")
            for name in (ESTIMATES, RECORD, SUMMARY):
                (self._out / (name + PARTIAL)).replace(self._out / name)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._csv.closed:
            for file in (self._csv, self._record):
                with suppress(OSError):  # disk full; the original exception is already propagating
                    file.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self._out}: cannot be written ({error.strerror}); is the disk full?") from None

    def _count(self, message: Message) -> None:
        if isinstance(message, MeasurementVerdict):
            self._verdicts[message.measurement][str(message.verdict)] += 1
            if message.measurement == "odometry" and message.verdict is not Verdict.ACCEPTED:
                self._registered[message.frame_id] = False
        elif isinstance(message, Origin):
            self._origin = message
        elif isinstance(message, CalibrationFault):
            self._faults.append((message.t_ns / NS, message))
        elif isinstance(message, CalibrationEstimate):
            self._calibration = message
        elif isinstance(message, MapMatch):
            self._matcher[str(message.verdict)] += 1
            self._matched_by[message.matcher] += 1
        elif isinstance(message, Odometry):
            # A frame that starts a fragment refers to itself: that is no registration.
            moved = message.verdict is Verdict.ACCEPTED and message.keyframe_id != message.frame_id
            self._registered[message.frame_id] = moved
