"""Verdict on a whole flight without ground truth: trusted, trusted from t1 to t2, or not trusted, with reasons."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from terrafix.core.clock import NS_PER_S
from terrafix.estimator.monitors.refused_pictures import DETAILS
from terrafix.link.ground_station.prior_request import MIN_DURATION_NS, MIN_FRAMES, UNANCHORED_SHARE
from terrafix.link.integrity.fix_type import DEGRADATION_LEVELS, MAX_HORIZONTAL_SIGMA_M
from terrafix.link.pilot_text.statustext import LINK_FAULTS, fault_text
from terrafix.messages import CalibrationFault, MeasurementVerdict, Origin, SourceLabel, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_tools.estimates import NS, Row, RowTable
from terrafix_tools.likely_cause import likely_cause

# Time that a flight may last on its initial position before a map match confirms it
MAX_UNCONFIRMED_S = DEGRADATION_LEVELS[1][0]
MAX_UNANCHORED_S = DEGRADATION_LEVELS[-1][0]  # longest time without a map match later on
MAX_REJECTED_SHARE, MIN_MATCHES = 0.5, 8  # of the poses found on the map, rejected by the estimator's innovation gate
# Faults that begin in flight; all others are of the description, which was wrong from the beginning.
BEGIN_IN_FLIGHT = ("registration", "picture upside down", "picture turned", "picture mirrored")
# Faults whose frames or telemetry were left out, or which the claim contains: the position went on.
REFUSED = (*DETAILS, "focal length", *LINK_FAULTS)
# One of map and initial position is wrong; no measurement on board decides which.
START_CONTRADICTS_MAP = "start and map contradict each other: one of them is in the wrong place"
MAX_SHOWN_SPANS = 3


@dataclass(frozen=True)
class FlightVerdict:
    """``spans``: (from, to) in seconds, in the time of the rows, that can be trusted. ``reasons``: why the rest cannot.
    ``files``, ``untrusted_files``: first and last image of each span, and of each one between them; empty names where
    images have none.
    """

    spans: list[tuple[float, float]]
    share: float  # of all frames, those that can be trusted
    reasons: list[str]
    active_faults: list[str]  # at the end of the flight
    cause: str = ""  # the likely one, of a flight that found nothing on the map
    files: tuple[tuple[str, str], ...] = ()
    untrusted_files: tuple[tuple[str, str], ...] = ()
    untrusted: tuple[tuple[float, float, str], ...] = ()  # as ``spans``, of the rest: from, to, reason
    asks: tuple[float, float, str] | None = None  # for a position between these times, with the reason
    refused: tuple[tuple[float, float, str], ...] = ()  # of inputs left out, whatever was trusted: from, to, which

    @property
    def label(self) -> str:
        if not self.spans:
            return "do not trust it"
        return "trust it" if self.share == 1.0 else "trust it in part"

    @property
    def is_trusted(self) -> bool:
        """All of the flight is."""
        return bool(self.spans) and self.share == 1.0

    def since(self, zero_s: float) -> "FlightVerdict":
        """The same with times since ``zero_s``."""
        spans = [(a - zero_s, b - zero_s) for a, b in self.spans]
        untrusted, refused = (
            tuple((a - zero_s, b - zero_s, why) for a, b, why in given) for given in (self.untrusted, self.refused)
        )
        asks = self.asks and (self.asks[0] - zero_s, self.asks[1] - zero_s, self.asks[2])
        return replace(self, spans=spans, untrusted=untrusted, refused=refused, asks=asks)

    def text(self) -> str:
        """One line for the operator."""
        refused = [f"{what} from {a:.1f} s to {b:.1f} s" for a, b, what in self.refused[:MAX_SHOWN_SPANS]]
        refused += ["..."] if len(self.refused) > MAX_SHOWN_SPANS else []
        because = f" ({'; '.join([*self.reasons, *refused])})" if self.reasons or refused else ""
        cause = f" Likely cause: {self.cause}." if self.cause else ""
        if self.asks is not None:
            from_s, to_s, why = self.asks
            cause = f" From {from_s:.1f} s to {to_s:.1f} s {why}: a user fix or a hint there would help.{cause}"
        if not self.spans or self.share == 1.0:
            return f"{self.label.capitalize()}{because}.{cause}"
        names = self.files or (("", ""),) * len(self.spans)
        shown = ", ".join(
            f"from {_moment(a, first)} to {_moment(b, last)}"
            for (a, b), (first, last) in zip(self.spans[:MAX_SHOWN_SPANS], names, strict=False)
        )
        more = len(self.spans) - MAX_SHOWN_SPANS
        others = f" and in {more} more spans" if more > 0 else ""
        return f"Trust it {shown}{others}, and no more than that{because}.{cause}"

    def as_json(self) -> dict[str, Any]:
        """The dict that summary.json contains."""
        return {
            "verdict": self.label,
            "trusted_s": [[round(a, 3), round(b, 3)] for a, b in self.spans],
            "untrusted_s": [[round(a, 3), round(b, 3), reason] for a, b, reason in self.untrusted],
            "refused_s": [[round(a, 3), round(b, 3), what] for a, b, what in self.refused],
            "trusted_files": [list(pair) for pair in self.files],
            "untrusted_files": [list(pair) for pair in self.untrusted_files],
            "trusted_share": round(self.share, 6),
            "reasons": self.reasons,
            "asks_s": None if self.asks is None else [round(self.asks[0], 3), round(self.asks[1], 3), self.asks[2]],
            "active_faults": self.active_faults,
            "cause": self.cause,
            "text": self.text(),
        }


def flight_verdict(
    rows: Sequence[Row],
    faults: Iterable[tuple[float, CalibrationFault]] = (),
    verdicts: Mapping[str, Mapping[str, int]] | None = None,
) -> FlightVerdict:
    """``rows``: the estimates. ``faults``: calibration faults with their time in seconds, on the time axis of the
    rows. ``verdicts``: for each measurement ("map", "start") the number of each verdict.
    """
    ordered = sorted(faults, key=lambda fault: fault[0])
    active: dict[str, tuple[float, CalibrationFault]] = {}
    ended: list[tuple[float, CalibrationFault, float]] = []
    for t_s, fault in ordered:
        if fault.active:
            active.setdefault(fault.quantity, (t_s, fault))
        elif fault.quantity in active:
            began_s, first = active.pop(fault.quantity)
            ended.append((began_s, first, t_s))
    every = [*ended, *((t_s, fault, math.inf) for t_s, fault in active.values())]
    faulty_spans = [
        (_fault_start_s(a, fault, rows), b, _fault_name(fault))
        for a, fault, b in every
        if fault.quantity not in REFUSED
    ]
    last_s = rows[-1].t_s if rows else 0.0
    refused = sorted((a, min(b, last_s), fault.quantity) for a, fault, b in every if fault.quantity in REFUSED)
    verdict_counts = verdicts or {}
    rejected = (
        START_CONTRADICTS_MAP if verdict_counts.get("start") else _rejected_matches(verdict_counts.get("map", {}))
    )
    confirmed = any(row.anchor_age_ms is not None and row.anchor_age_ms >= 0 for row in rows)
    unconfirmed_until_s = rows[0].t_s + MAX_UNCONFIRMED_S if confirmed else -math.inf
    distrust = [rejected or _distrust_reason(row, unconfirmed_until_s, faulty_spans) for row in rows]
    spans: list[tuple[float, float]] = []
    files: dict[bool, list[tuple[str, str]]] = {True: [], False: []}
    for trusted, group in groupby(zip(rows, distrust, strict=True), key=lambda pair: not pair[1]):
        span = [row for row, _ in group]
        files[trusted].append((span[0].file, span[-1].file))
        if trusted:
            spans.append((span[0].t_s, span[-1].t_s))
    untrusted = [
        (part[0].t_s, part[-1].t_s, reason)
        for reason, part_pairs in groupby(zip(rows, distrust, strict=True), key=lambda pair: pair[1])
        if reason and (part := [pair[0] for pair in part_pairs])
    ]
    reasons = list(dict.fromkeys(reason for reason in distrust if reason))
    if not rows:
        reasons = ["no frame"]
    share = sum(not reason for reason in distrust) / max(len(rows), 1)
    anchored = sum(row.anchor_age_ms == 0 for row in rows)
    cause = likely_cause(len(rows), anchored, (fault for _, fault in ordered), verdict_counts)
    names = [_fault_name(fault) for _, fault in active.values() if fault.quantity not in REFUSED]
    return FlightVerdict(
        spans, share, reasons, names, cause, tuple(files[True]), tuple(files[False]), tuple(untrusted),
        refused=tuple(refused), asks=_asks(rows),
    )  # fmt: skip


def verdict_of(folder: Path, zero_s: float | None = None) -> FlightVerdict:
    """Returns the verdict for the record in a folder, with times since ``zero_s`` of its messages (None: the
    origin of the flight). Raises SourceError when there is none.
    """
    table = RowTable()
    faults: list[tuple[float, CalibrationFault]] = []
    verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for _, _, message in read_flight(folder):
        table.take(message)
        if isinstance(message, Origin) and zero_s is None:
            zero_s = message.t_ns / NS
        if isinstance(message, CalibrationFault):
            faults.append((message.t_ns / NS, message))
        elif isinstance(message, MeasurementVerdict):
            verdicts[message.measurement][str(message.verdict)] += 1
    found = flight_verdict(list(table.rows.values()), faults, verdicts)
    return found.since(zero_s or 0.0)


def _asks(rows: Sequence[Row]) -> tuple[float, float, str] | None:
    """The longest stretch without a map match, if it is as long as the pilot would be asked for, and a fifth of the
    frames: from, to, and how many frames."""
    stretches = [list(group) for found, group in groupby(rows, key=lambda row: row.anchor_age_ms == 0) if not found]
    longest = max(stretches, key=len, default=[])
    if len(longest) < max(MIN_FRAMES, UNANCHORED_SHARE * len(rows)):
        return None
    from_s, to_s = longest[0].t_s, longest[-1].t_s
    if to_s - from_s < MIN_DURATION_NS / NS_PER_S:
        return None
    return from_s, to_s, f"no map match in {len(longest)} of {len(rows)} frames"


def _moment(t_s: float, file: str) -> str:
    return f"{t_s:.1f} s ({file})" if file else f"{t_s:.1f} s"


def _distrust_reason(row: Row, unconfirmed_until_s: float, faulty_spans: list[tuple[float, float, str]]) -> str:
    """Returns the reason not to trust the row; empty when it can be trusted. ``unconfirmed_until_s``: time until which
    it may rest on the start of the flight alone.
    """
    for from_s, to_s, reason in faulty_spans:
        if from_s <= row.t_s < to_s:
            return reason
    if not row.localised or row.sigma_e_m is None or row.sigma_n_m is None:
        return "not found on the map" if row.source_label == SourceLabel.NOT_PLACED else "no position"
    if math.hypot(row.sigma_e_m, row.sigma_n_m) / math.sqrt(2.0) > MAX_HORIZONTAL_SIGMA_M:
        return f"claims worse than {MAX_HORIZONTAL_SIGMA_M:.0f} m"
    age_ms = row.anchor_age_ms
    if age_ms is None or age_ms < 0:
        return "" if row.t_s <= unconfirmed_until_s else "no map match has confirmed the start"
    return "" if age_ms <= MAX_UNANCHORED_S * 1e3 else f"no map match for over {MAX_UNANCHORED_S:.0f} s"


def _fault_start_s(alarm_s: float, fault: CalibrationFault, rows: Sequence[Row]) -> float:
    """Returns the time from which a fault applies. A wrong description (camera, heading, height) is wrong from the
    beginning; a map without matches, or the picture of a camera that came back turned, applies since the last match.
    """
    if fault.quantity not in BEGIN_IN_FLIGHT:
        return -math.inf
    anchored = [row.t_s for row in rows if row.t_s <= alarm_s and row.anchor_age_ms == 0]
    return max(anchored, default=-math.inf) + 1e-9


def _rejected_matches(verdict_counts: Mapping[str, int]) -> str:
    rejected, accepted = verdict_counts.get(Verdict.INNOVATION, 0), verdict_counts.get(Verdict.ACCEPTED, 0)
    if rejected + accepted < MIN_MATCHES or rejected <= MAX_REJECTED_SHARE * (rejected + accepted):
        return ""
    return f"{rejected} of {rejected + accepted} map matches were rejected"


def _fault_name(fault: CalibrationFault) -> str:
    return fault_text(fault).removesuffix(": no fix").removesuffix(": not used")
