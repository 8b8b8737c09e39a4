"""The data of a report."""

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from terrafix.core.gate import CHI2_95
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
    Origin,
    ProcessEvent,
    SearchState,
    StatusText,
    ThermalReading,
)
from terrafix.recorder.reader import ReadResult
from terrafix_tools.camera_times import CameraTimes
from terrafix_tools.estimates import NS, Row
from terrafix_tools.evaluate import Compared, Truth
from terrafix_tools.log.contents import Contents
from terrafix_tools.report.innovations import Innovations
from terrafix_tools.report.stage_times import StageTimes


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
    matched_by: Counter[str] = field(default_factory=Counter)  # frames by features: MapMatch.matcher
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
    finalised_flights: list[dict[str, Any]] = field(default_factory=list)  # of finalised.json
    evaluation: dict[str, Any] | None = None
    peer: dict[str, Any] = field(default_factory=dict)  # peer.json of the simulated autopilot
    cut_off: int = 0  # number of record files without end
    clocked: bool = False  # the record has times of reception: a live one, whose messages have a delay
    contents: Contents = field(default_factory=lambda: Contents(Path(), ReadResult()))
    folder: Path = Path()
    zero_ns: int = 0  # time of the first frame on the clock of the record
    map_matches: list[tuple[float, int]] = field(default_factory=list)  # t_s, frame id; those with 2D-3D matches
    innovations: dict[str, Innovations] = field(default_factory=dict)  # by measurement
    stage_times: StageTimes = field(default_factory=StageTimes)
    camera_times: CameraTimes = field(default_factory=CameraTimes)
    ekf: list[tuple[float, EkfStatus]] = field(default_factory=list)
    link_states: list[tuple[float, LinkStatus]] = field(default_factory=list)
    gnss_readings: list[tuple[float, GnssReading]] = field(default_factory=list)
    gnss_verdicts: list[tuple[float, GnssVerdict]] = field(default_factory=list)
    thermal: list[tuple[float, ThermalReading]] = field(default_factory=list)
    frame_rates: list[tuple[float, FrameRate]] = field(default_factory=list)
    searches: list[tuple[float, SearchState]] = field(default_factory=list)
    losses: list[tuple[float, Dropped]] = field(default_factory=list)

    @property
    def duration_s(self) -> float:
        ends = [self.rows[-1].t_s] if self.rows else []
        ends += [series[-1][0] for series in (self.gps, self.health) if series]
        return max(ends, default=0.0)

    @property
    def link(self) -> LinkStatus | None:
        """The last state of the link."""
        return self.link_states[-1][1] if self.link_states else None

    def log_s(self, t_s: float) -> float:
        """Time of `terrafix log show`, which counts from Origin."""
        return t_s + (self.zero_ns - self.origin.t_ns) / NS if self.origin is not None else 0.0

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
    return math.sqrt(CHI2_95 * (mean + spread)), math.sqrt(CHI2_95 * max(0.0, mean - spread)), angle
