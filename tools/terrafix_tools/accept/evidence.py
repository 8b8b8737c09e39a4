"""What a replayed scenario left behind, frame by frame, for the judge: rows, truth and the recorded messages."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.messages import (
    Frame,
    Health,
    MapMatch,
    MeasurementVerdict,
    NavEstimate,
    Odometry,
    Origin,
    Prediction,
    SearchState,
    Verdict,
)
from terrafix.recorder.reader import read_flight
from terrafix_tools.accept.faults import original
from terrafix_tools.accept.judged import Marks
from terrafix_tools.estimates import ESTIMATES, Row, read_rows
from terrafix_tools.evaluate import Compared, Truth, compare, metrics, read_summary

STAMP_S = 1e-3  # times of one row are rounded to this


@dataclass
class Seen:
    """One frame: what was said of it, and how far that is from the truth (None: no truth, or no position)."""

    row: Row
    compared: Compared | None = None
    estimates: list[NavEstimate] = field(default_factory=list)
    odometry: Odometry | None = None
    odometry_verdict: Verdict | None = None
    prediction: Prediction | None = None
    match: MapMatch | None = None
    map_verdict: Verdict | None = None

    @property
    def t_s(self) -> float:
        return self.row.t_s

    @property
    def error_m(self) -> float | None:
        return self.compared.error_m if self.compared else None

    @property
    def fixed(self) -> bool:
        """The estimator took a map fix of this very frame."""
        return self.map_verdict is Verdict.ACCEPTED


@dataclass(frozen=True)
class SentFix:
    """One GPS_INPUT of a closed loop, beside what was true at its time."""

    t_s: float  # of the flight
    error_m: float | None  # horizontal; None: it has no 3D fix
    accuracy_m: float  # 1-sigma that it claims
    aside_m: float  # of the vehicle: its distance from the way that it flies without the lie
    reason: str = ""  # why it has no fix


@dataclass
class Evidence:
    origin: Origin
    frames: list[Seen]
    marks: Marks
    metrics: dict[str, Any]  # evaluation.json of this scenario
    summary: dict[str, Any]
    hot: set[int]  # t_ns at which the computer was said to be hot
    start_up_s: float  # from the start of the program to its first frame
    peer: dict[str, Any]  # peer.json of a closed loop; empty for a replay
    searches: list[SearchState] = field(default_factory=list)  # changes of the search, in order
    sent: list[SentFix] = field(default_factory=list)  # of a closed loop with a lie in it; empty otherwise

    @property
    def span_s(self) -> float:
        return self.frames[-1].t_s - self.frames[0].t_s

    def within(self, span_number: int) -> list[Seen]:
        return [f for f in self.frames if self.marks.spans[span_number].has(f.t_s)]

    def local_truth_m(self, frame: Seen) -> np.ndarray | None:
        """(2,) east, north in the flight's local frame."""
        if frame.compared is None:
            return None
        place = LocalFrame(self.origin.lat_deg, self.origin.lon_deg)
        return np.array(place.to_local(frame.compared.truth.lat_deg, frame.compared.truth.lon_deg), dtype=float)


def moved_truth(truth: dict[str, Truth], east_m: float, north_m: float) -> dict[str, Truth]:
    """Every position moved by the same metres: as a map that is off by the opposite would have it."""
    first = next(iter(truth.values()))
    place = LocalFrame(first.lat_deg, first.lon_deg)
    moved = {}
    for file, at in truth.items():
        e_m, n_m = place.to_local(at.lat_deg, at.lon_deg)
        moved[file] = Truth(*place.to_wgs84(float(e_m) + east_m, float(n_m) + north_m))
    return moved


def truth_of_estimates(frames: list[Seen], truth: dict[str, Truth]) -> dict[str, Truth]:
    """Truth by file, of the time that each frame's newest estimate is of. ``truth``: of the times of the frames.

    An estimator that knows how late its pictures are has them at an earlier time than they were stamped with; between
    two frames the truth is a straight line."""
    known = [frame for frame in frames if frame.row.file in truth]
    times_s = [frame.t_s for frame in known]
    lat_deg = [truth[frame.row.file].lat_deg for frame in known]
    lon_deg = [truth[frame.row.file].lon_deg for frame in known]
    at = {}
    for frame in known:
        t_s = frame.estimates[-1].t_ns * 1e-9 if frame.estimates else frame.t_s
        same = abs(t_s - frame.t_s) < STAMP_S
        there = Truth(float(np.interp(t_s, times_s, lat_deg)), float(np.interp(t_s, times_s, lon_deg)))
        at[frame.row.file] = truth[frame.row.file] if same else there
    return at


def gather(
    out: Path,
    truth: dict[str, Truth],
    marks: Marks,
    *,
    start_up_s: float = 0.0,
    truth_offset_m: tuple[float, float] = (0.0, 0.0),
    peer: dict[str, Any] | None = None,
) -> Evidence:
    """Of the replay in ``out``. Truth is found by the file's own name, whatever lap it was flown in.

    ``truth_offset_m``: east, north; how far the map is off.

    Raises EvaluationError, SourceError."""
    rows = read_rows(out / ESTIMATES)
    names = original(row.file for row in rows)
    moved = moved_truth(truth, *truth_offset_m)
    summary = read_summary(out)
    frames = [Seen(row) for row in rows]
    by_id: dict[int, Seen] = {}  # rows are in the order in which frames were said
    origin, hot, searches = None, set(), []
    for _, _, message in read_flight(out):
        match message:
            case Origin():
                origin = message
            case Frame():
                by_id.setdefault(message.frame_id, frames[min(len(by_id), len(frames) - 1)])
            case NavEstimate():
                by_id[message.frame_id].estimates.append(message)
            case Odometry():
                by_id[message.frame_id].odometry = message
            case Prediction():
                by_id[message.frame_id].prediction = message
            case MapMatch():
                by_id[message.frame_id].match = message
            case MeasurementVerdict(measurement="odometry"):
                by_id[message.frame_id].odometry_verdict = message.verdict
            case MeasurementVerdict(measurement="map"):
                by_id[message.frame_id].map_verdict = message.verdict
            case SearchState():
                searches.append(message)
            case Health() if message.throttled:
                hot.add(message.t_ns)
            case _:
                pass
    assert origin is not None
    at_stamps = {row.file: moved[name] for row, name in zip(rows, names, strict=True) if name in moved}
    truth = truth_of_estimates(frames, at_stamps)
    compared = {c.row.file: c for c in compare(rows, truth)}
    for frame in frames:
        frame.compared = compared.get(frame.row.file)
    of_all = metrics(rows, truth, summary, None)
    return Evidence(origin, frames, marks, of_all, summary, hot, start_up_s, peer or {}, searches)
