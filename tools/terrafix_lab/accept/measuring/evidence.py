"""Evidence of a replayed scenario for the criteria, frame by frame: rows, truth and the recorded messages."""

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
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Prediction,
    Refinement,
    RefinementSource,
    SearchState,
    Verdict,
)
from terrafix.recorder.reader import read_flight
from terrafix_lab.accept.long_route import original
from terrafix_lab.accept.measuring.results import Marks
from terrafix_tools.estimates import ESTIMATES, Row, read_rows
from terrafix_tools.evaluate import Compared, Truth, compare, metrics, read_summary

STAMP_S = 1e-3  # resolution of the times in estimates.csv


@dataclass
class FrameEvidence:
    """One frame: all messages about it, and its error against the truth (None: no truth, or no position)."""

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
        """The estimator accepted a map fix of this frame."""
        return self.map_verdict is Verdict.ACCEPTED


@dataclass(frozen=True)
class SentFix:
    """One GPS_INPUT of a closed loop, and the truth at its time."""

    t_s: float  # of the flight
    error_m: float | None  # horizontal; None: it has no 3D fix
    accuracy_m: float  # stated 1-sigma
    deviation_m: float  # distance of the vehicle from the reference flight without the false input
    reason: str = ""  # for having no fix


@dataclass
class Evidence:
    origin: Origin
    frames: list[FrameEvidence]
    marks: Marks
    metrics: dict[str, Any]  # evaluation.json of this scenario
    summary: dict[str, Any]
    hot: set[int]  # t_ns at which Health reported thermal throttling
    start_up_s: float  # from the start of the program to its first frame
    peer: dict[str, Any]  # peer.json of a closed loop; empty for a replay
    searches: list[SearchState] = field(default_factory=list)  # state changes of the search, in order
    sent: list[SentFix] = field(default_factory=list)  # of a closed loop with a false input; empty otherwise
    # Time at which the smoother has published the first refined pose of a frame in flight, by fragment
    refined_ns: dict[int, int] = field(default_factory=dict)

    @property
    def span_s(self) -> float:
        return self.frames[-1].t_s - self.frames[0].t_s

    def within(self, span_number: int) -> list[FrameEvidence]:
        return [f for f in self.frames if self.marks.spans[span_number].has(f.t_s)]

    def local_truth_m(self, frame: FrameEvidence) -> np.ndarray | None:
        """(2,) east, north in the flight's local frame."""
        if frame.compared is None:
            return None
        place = LocalFrame(self.origin.lat_deg, self.origin.lon_deg)
        return np.array(place.to_local(frame.compared.truth.lat_deg, frame.compared.truth.lon_deg), dtype=float)


def moved_truth(truth: dict[str, Truth], east_m: float, north_m: float) -> dict[str, Truth]:
    """All positions shifted by the same offset: the truth relative to a map with the opposite error."""
    first = next(iter(truth.values()))
    place = LocalFrame(first.lat_deg, first.lon_deg)
    moved = {}
    for file, at in truth.items():
        e_m, n_m = place.to_local(at.lat_deg, at.lon_deg)
        moved[file] = Truth(*place.to_wgs84(float(e_m) + east_m, float(n_m) + north_m))
    return moved


def truth_of_estimates(frames: list[FrameEvidence], truth: dict[str, Truth]) -> dict[str, Truth]:
    """Truth by file at the time of each frame's newest estimate. ``truth``: at the time stamps of the frames.

    The time of an estimate is earlier than the stamp if the estimator corrects a time offset of the camera. Between
    frames the truth is interpolated linearly."""
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


def _add_to_frame(message: Message, by_id: dict[int, FrameEvidence]) -> None:
    """Stores a message about a frame with that frame."""
    match message:
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
        case _:
            pass


def gather(
    out: Path,
    truth: dict[str, Truth],
    marks: Marks,
    *,
    start_up_s: float = 0.0,
    truth_offset_m: tuple[float, float] = (0.0, 0.0),
    peer: dict[str, Any] | None = None,
) -> Evidence:
    """Evidence of the replay in ``out``. Truth is looked up by the original file name, for frames of any lap.

    ``truth_offset_m``: east, north; error of the map. Raises EvaluationError, SourceError."""
    rows = read_rows(out / ESTIMATES)
    names = original(row.file for row in rows)
    moved = moved_truth(truth, *truth_offset_m)
    summary = read_summary(out)
    frames = [FrameEvidence(row) for row in rows]
    by_id: dict[int, FrameEvidence] = {}  # rows are in the order of the Frame messages
    origin, hot, searches, refined_ns = None, set(), [], dict[int, int]()
    for _, _, message in read_flight(out):
        match message:
            case Origin():
                origin = message
            case Frame():
                by_id.setdefault(message.frame_id, frames[min(len(by_id), len(frames) - 1)])
            case SearchState():
                searches.append(message)
            case Refinement(source=RefinementSource.SMOOTHER):
                for pose in message.poses:
                    refined_ns.setdefault(pose.fragment_id, message.t_ns)
            case Health() if message.throttled:
                hot.add(message.t_ns)
            case _:
                _add_to_frame(message, by_id)
    assert origin is not None
    at_stamps = {row.file: moved[name] for row, name in zip(rows, names, strict=True) if name in moved}
    truth = truth_of_estimates(frames, at_stamps)
    compared = {c.row.file: c for c in compare(rows, truth)}
    for frame in frames:
        frame.compared = compared.get(frame.row.file)
    of_all = metrics(rows, truth, summary, None)
    return Evidence(
        origin, frames, marks, of_all, summary, hot, start_up_s, peer or {}, searches, refined_ns=refined_ns
    )
