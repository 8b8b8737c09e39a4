"""Collects the data of a report from the folder of a replay or of a live run."""

import json
import math
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.core.errors import EvaluationError, SourceError
from terrafix.messages import (
    CalibrationEstimate,
    CalibrationFault,
    Dropped,
    GpsInput,
    Health,
    LinkStatus,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Origin,
    ProcessEvent,
    StatusText,
    Verdict,
)
from terrafix.recorder.reader import ReadResult, read_received, read_thumbnails
from terrafix_tools.estimates import ESTIMATES, NS, PARTIAL, Row, RowTable, read_rows
from terrafix_tools.evaluate import (
    ELLIPSE95,
    Compared,
    Truth,
    compare,
    metrics,
    read_summary,
    read_truth,
    truth_sigma_of,
)
from terrafix_tools.finalise.output import TABLE as FINALISED
from terrafix_tools.finalise.output import read_track
from terrafix_tools.log.contents import Contents


@dataclass(frozen=True)
class RejectedMatch:
    """A map match that was rejected. ``by_anchor``: its MapMatch has that verdict already; else the estimator raised
    it."""

    t_s: float
    frame_id: int
    verdict: str
    by_anchor: bool
    test_ratio: float | None
    detail: str


@dataclass
class FlightView:
    """Data of a report, in order of time; times in seconds from the first frame."""

    title: str
    rows: list[Row]
    frame_ids: list[int]
    origin: Origin | None = None
    calibration: CalibrationEstimate | None = None  # the last one
    unfinished: bool = False  # an interrupted replay
    live: bool = False  # from a live record; process_ms is then the delay of the estimate
    summary: dict[str, Any] = field(default_factory=dict)
    header: dict[str, Any] = field(default_factory=dict)
    verdicts: dict[str, Counter[str]] = field(default_factory=dict)
    map_verdict: dict[int, str] = field(default_factory=dict)  # by frame id
    rejected_maps: list[RejectedMatch] = field(default_factory=list)
    health: list[tuple[float, Health]] = field(default_factory=list)  # t_s, state of the computer
    gps: list[tuple[float, GpsInput]] = field(default_factory=list)
    faults: list[tuple[float, CalibrationFault]] = field(default_factory=list)
    events: list[tuple[float, ProcessEvent]] = field(default_factory=list)
    pilot_texts: list[tuple[float, StatusText]] = field(default_factory=list)
    dropped: Counter[str] = field(default_factory=Counter)  # "process: message"
    thumbnails: dict[int, bytes] = field(default_factory=dict)
    compared: dict[str, Compared] = field(default_factory=dict)  # by file, if there is ground truth
    truth_track: list[Truth] = field(default_factory=list)
    finalised: list[tuple[float, float]] = field(default_factory=list)  # latitude, longitude of finalised.csv
    evaluation: dict[str, Any] | None = None
    peer: dict[str, Any] = field(default_factory=dict)  # peer.json of the simulated autopilot
    cut_off: int = 0  # number of record files without end
    link: LinkStatus | None = None  # the last one
    clocked: bool = False  # the record has times of reception: a live one, whose messages have a delay
    contents: Contents = field(default_factory=lambda: Contents(Path(), ReadResult()))

    @property
    def duration_s(self) -> float:
        ends = [self.rows[-1].t_s] if self.rows else []
        ends += [series[-1][0] for series in (self.gps, self.health) if series]
        return max(ends, default=0.0)

    def error_m(self, row: Row) -> float | None:
        compared = self.compared.get(row.file)
        return compared.error_m if compared else None

    def refined_error_m(self, row: Row) -> float | None:
        compared = self.compared.get(row.file)
        return compared.refined_error_m if compared else None


def radius95_m(row: Row) -> float | None:
    """Semi-major axis of the reported 95 % ellipse, m."""
    axes = ellipse95(row)
    return axes[0] if axes else None


def ellipse95(row: Row) -> tuple[float, float, float] | None:
    """Returns the semi-axes a >= b (m) and the direction of a (radians from east towards north) of the reported 95 %
    ellipse.
    """
    if row.sigma_e_m is None or row.sigma_n_m is None or row.cov_en_m2 is None:
        return None
    ee, nn, en = row.sigma_e_m**2, row.sigma_n_m**2, row.cov_en_m2
    mean, spread = (ee + nn) / 2, math.hypot((ee - nn) / 2, en)
    angle = math.atan2(2 * en, ee - nn) / 2
    return math.sqrt(ELLIPSE95 * (mean + spread)), math.sqrt(ELLIPSE95 * max(0.0, mean - spread)), angle


def gather(folder: Path, truth_path: Path | None) -> FlightView:
    """Collects the data. Raises SourceError when the folder has no flight, EvaluationError when the truth does not
    match.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; give the output of replay, run or demo")
    summary = read_summary(folder)
    table, zero_ns, view = read_record(folder)
    tables = [path for name in (ESTIMATES, ESTIMATES + PARTIAL) if (path := folder / name).is_file()]
    if tables:
        view.rows = read_rows(tables[0])
        view.unfinished = tables[0].name != ESTIMATES
    else:
        view.live = True
        view.rows = list(table.rows.values())
    view.frame_ids = list(table.rows)
    if not view.rows:
        raise SourceError(f"{folder}: the record contains no frame; was the source of the flight opened?")
    for row in view.rows:
        row.t_s -= zero_ns / NS
    view.summary = summary
    view.title = str(summary.get("flight") or folder.resolve().name)
    view.thumbnails = dict(read_thumbnails(folder))
    view.peer = _read_peer(folder / "peer.json")
    if (folder / FINALISED).is_file():
        view.finalised = read_track(folder / FINALISED)
    default_truth = folder / "truth.csv"
    if truth_path is None and default_truth.is_file():
        truth_path = default_truth
    if truth_path is not None:
        _add_truth(view, truth_path)
    return view


def _add_truth(view: FlightView, truth_path: Path) -> None:
    truth = read_truth(truth_path)
    view.compared = {c.row.file: c for c in compare(view.rows, truth)}
    view.evaluation = metrics(view.rows, truth, view.summary, truth_sigma_of(truth_path))
    view.truth_track = [c.truth for c in view.compared.values()]


def _read_peer(path: Path) -> dict[str, Any]:
    try:
        peer = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise EvaluationError(f"{path}: cannot be read ({error})") from None
    return peer if isinstance(peer, dict) else {}


def read_record(path: Path) -> tuple[RowTable, int, FlightView]:
    """Reads a record (a file, or the folder of a replay or run) in one pass. Returns the rows, the time of the first
    frame, and the view without rows."""
    result = ReadResult()
    table = RowTable()
    view = FlightView(title="", rows=[], frame_ids=[], contents=Contents(path, result))
    verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    sent_ns: dict[int, int] = {}
    timed: list[tuple[int, Message]] = []
    anchor_verdict: dict[int, Verdict] = {}  # by frame id
    rejected: list[MeasurementVerdict] = []
    for _, t_ns, received_ns, message in read_received(path, result):
        table.take(message)
        view.contents.take(t_ns, message)
        view.clocked = view.clocked or received_ns != message.t_ns
        if isinstance(message, NavEstimate):
            # Delay of the last estimate of a frame, which is the one in its row; the recorder's clock has a resolution
            # of 10 ms.
            sent_ns[message.frame_id] = received_ns - message.t_ns
        elif isinstance(message, MeasurementVerdict):
            verdicts[message.measurement][str(message.verdict)] += 1
            if message.measurement == "map":
                view.map_verdict[message.frame_id] = str(message.verdict)
                if message.verdict is not Verdict.ACCEPTED:
                    rejected.append(message)
        elif isinstance(message, MapMatch):
            view.map_verdict.setdefault(message.frame_id, str(message.verdict))
            anchor_verdict[message.frame_id] = message.verdict
        elif isinstance(message, Origin):
            view.origin = message
        elif isinstance(message, CalibrationEstimate):
            view.calibration = message
        elif isinstance(message, LinkStatus):
            view.link = message
        elif isinstance(message, Dropped):
            view.dropped[f"{message.process}: {message.message}"] += message.count
        elif isinstance(message, Health | GpsInput | ProcessEvent | StatusText | CalibrationFault):
            timed.append((t_ns, message))
    for frame_id, row in table.rows.items():
        if frame_id in sent_ns:
            row.process_ms = sent_ns[frame_id] / 1e6
    zero_ns = round(min((row.t_s for row in table.rows.values()), default=0.0) * NS)
    _add_timed(view, timed, zero_ns)
    view.rejected_maps = [
        RejectedMatch(
            (m.t_ns - zero_ns) / NS,
            m.frame_id,
            str(m.verdict),
            anchor_verdict.get(m.frame_id) is m.verdict,
            m.test_ratio,
            m.detail,
        )
        for m in rejected
    ]
    view.verdicts = dict(sorted(verdicts.items()))
    view.header = result.header
    view.cut_off = len(result.truncated_files)
    return table, zero_ns, view


def _add_timed(view: FlightView, timed: list[tuple[int, Message]], zero_ns: int) -> None:
    """Adds messages with their record times (ns) to the series of the view, in order of time."""
    for t_ns, message in sorted(timed, key=lambda item: item[0]):
        t_s = (t_ns - zero_ns) / NS
        if isinstance(message, Health):
            view.health.append((t_s, message))
        elif isinstance(message, GpsInput):
            view.gps.append((t_s, message))
        elif isinstance(message, CalibrationFault):
            view.faults.append((t_s, message))
        elif isinstance(message, ProcessEvent):
            view.events.append((t_s, message))
        elif isinstance(message, StatusText):
            view.pilot_texts.append((t_s, message))
