"""Collects the data of a report from the folder of a replay or of a live run."""

import json
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from terrafix.core.errors import EvaluationError, SourceError
from terrafix.messages import (
    CalibrationEstimate,
    CalibrationFault,
    Dropped,
    EkfStatus,
    FrameRate,
    GnssReading,
    GnssVerdict,
    GpsInput,
    Health,
    LinkStatus,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Origin,
    ProcessEvent,
    SearchState,
    StatusText,
    ThermalReading,
    Verdict,
)
from terrafix.recorder.reader import ReadResult, read_received
from terrafix_tools.estimates import ESTIMATES, NS, PARTIAL, RowTable, read_rows
from terrafix_tools.evaluate import compare, metrics, read_summary, read_truth, truth_sigma_of
from terrafix_tools.finalised import SUMMARY as FINALISED_SUMMARY
from terrafix_tools.finalised import TABLE as FINALISED
from terrafix_tools.finalised import read_flights, read_track
from terrafix_tools.log.contents import Contents
from terrafix_tools.report.data import FlightView, RejectedMatch
from terrafix_tools.report.innovations import Innovations


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
    view.folder = folder
    view.summary = summary
    view.title = str(summary.get("flight") or folder.resolve().name)
    view.peer = _read_peer(folder / "peer.json")
    if (folder / FINALISED).is_file():
        view.finalised = read_track(folder / FINALISED)
        view.finalised_flights = read_flights(folder / FINALISED_SUMMARY)
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
    frame, and the view without rows.

    Matches and pictures are not kept: those of an hour are larger than the memory of a small computer."""
    result = ReadResult()
    table = RowTable()
    view = FlightView(title="", rows=[], frame_ids=[], contents=Contents(path, result))
    verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    sent_ns: dict[int, int] = {}
    timed: list[tuple[int, Message]] = []
    matched: list[tuple[int, int]] = []
    anchor_verdict: dict[int, Verdict] = {}  # by frame id
    rejected: list[MeasurementVerdict] = []
    for _, t_ns, received_ns, message in read_received(path, result):
        table.take(message)
        view.contents.take(t_ns, message)
        view.clocked = view.clocked or received_ns != message.t_ns
        view.stage_times.take(received_ns, message)
        view.camera_times.take(received_ns, message)
        if isinstance(message, NavEstimate):
            # Delay of the last estimate of a frame, which is the one in its row; the recorder's clock has a resolution
            # of 10 ms.
            sent_ns[message.frame_id] = received_ns - message.t_ns
        elif isinstance(message, MeasurementVerdict):
            verdicts[message.measurement][str(message.verdict)] += 1
            view.innovations.setdefault(message.measurement, Innovations()).take(message)
            if message.measurement == "map":
                view.map_verdict[message.frame_id] = str(message.verdict)
                if message.verdict is not Verdict.ACCEPTED:
                    rejected.append(message)
        elif isinstance(message, MapMatch):
            view.map_verdict.setdefault(message.frame_id, str(message.verdict))
            view.matched_by[message.matcher] += 1
            anchor_verdict[message.frame_id] = message.verdict
            if message.matches:
                matched.append((message.t_ns, message.frame_id))
        elif isinstance(message, Origin):
            view.origin = view.origin or message
        elif isinstance(message, CalibrationEstimate):
            view.calibration = message
        elif isinstance(message, tuple(_SERIES)):
            timed.append((t_ns, message))
    for frame_id, row in table.rows.items():
        if frame_id in sent_ns:
            row.process_ms = sent_ns[frame_id] / 1e6
    zero_ns = round(min((row.t_s for row in table.rows.values()), default=0.0) * NS)
    view.zero_ns = zero_ns
    view.map_matches = sorted(((t_ns - zero_ns) / NS, frame_id) for t_ns, frame_id in matched)
    _add_timed(view, timed)
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
    view.innovations = dict(sorted(view.innovations.items()))
    view.header = result.header
    view.cut_off = len(result.truncated_files)
    return table, zero_ns, view


# Field of FlightView that takes the messages of a type.
_SERIES: dict[type[Message], str] = {
    CalibrationFault: "faults",
    Dropped: "losses",
    EkfStatus: "ekf",
    FrameRate: "frame_rates",
    GnssReading: "gnss_readings",
    GnssVerdict: "gnss_verdicts",
    GpsInput: "gps",
    Health: "health",
    LinkStatus: "link_states",
    ProcessEvent: "events",
    SearchState: "searches",
    StatusText: "pilot_texts",
    ThermalReading: "thermal",
}


def _add_timed(view: FlightView, timed: list[tuple[int, Message]]) -> None:
    """Adds messages with their record times (ns) to the series of the view, in order of time."""
    for t_ns, message in sorted(timed, key=lambda item: item[0]):
        getattr(view, _SERIES[type(message)]).append(((t_ns - view.zero_ns) / NS, message))
    for _, loss in view.losses:
        view.dropped[f"{loss.process}: {loss.message}"] += loss.count
