"""The verdict on a whole flight, judged without truth: trust it, from t1 to t2, or do not, and why."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

from terrafix.link.integrity.fix_type import DEGRADATION_LEVELS, MAX_HORIZONTAL_SIGMA_M
from terrafix.link.pilot_text.statustext import fault_words
from terrafix.messages import CalibrationFault, MeasurementVerdict, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_tools.estimates import NS, Row, RowTable

UNCONFIRMED_S = DEGRADATION_LEVELS[1][
    0
]  # a flight may last so long on its start coordinate before a map match confirms it
UNANCHORED_S = DEGRADATION_LEVELS[-1][0]  # ... and so long without one later on
REFUSED_SHARE, LEAST_POSES = 0.5, 8  # of the poses on the map, refused by the estimate: one of the two is wrong
# Nothing on board tells which of the two.
START_OFF = "start and map contradict each other: one of them is in the wrong place"
SHOWN_SPANS = 3


@dataclass(frozen=True)
class FlightVerdict:
    """``spans``: (from, to) seconds, in the time of the rows, of what can be trusted. ``reasons``: why not all can."""

    spans: list[tuple[float, float]]
    share: float  # of the frames that can be trusted
    reasons: list[str]
    active_faults: list[str]  # when the flight ended

    @property
    def word(self) -> str:
        if not self.spans:
            return "do not trust it"
        return "trust it" if self.share == 1.0 else "trust it in part"

    def text(self) -> str:
        """One line for a person."""
        because = f" ({'; '.join(self.reasons)})" if self.reasons else ""
        if not self.spans or self.share == 1.0:
            return f"{self.word.capitalize()}{because}."
        shown = ", ".join(f"from {a:.1f} s to {b:.1f} s" for a, b in self.spans[:SHOWN_SPANS])
        more = len(self.spans) - SHOWN_SPANS
        return f"Trust it {shown}{f' and in {more} more spans' if more > 0 else ''}, and no more than that{because}."

    def as_json(self) -> dict[str, Any]:
        """As summary.json has it."""
        return {
            "verdict": self.word,
            "trusted_s": [[round(a, 3), round(b, 3)] for a, b in self.spans],
            "trusted_share": round(self.share, 6),
            "reasons": self.reasons,
            "active_faults": self.active_faults,
            "text": self.text(),
        }


def flight_verdict(
    rows: Sequence[Row],
    faults: Iterable[tuple[float, CalibrationFault]] = (),
    verdicts: Mapping[str, Mapping[str, int]] | None = None,
) -> FlightVerdict:
    """``faults`` with their times in seconds, as the rows have theirs; ``verdicts``: how often each measurement ("map",
    "start") got each verdict."""
    ordered = sorted(faults, key=lambda fault: fault[0])
    active: dict[str, tuple[float, CalibrationFault]] = {}
    wrong: list[tuple[float, float, str]] = []
    for t_s, fault in ordered:
        if fault.active:
            active.setdefault(fault.quantity, (t_s, fault))
        elif fault.quantity in active:
            began_s, first = active.pop(fault.quantity)
            wrong.append((_since(began_s, first, rows), t_s, _named(first)))
    wrong += [(_since(t_s, fault, rows), math.inf, _named(fault)) for t_s, fault in active.values()]
    answers = verdicts or {}
    refused = START_OFF if answers.get("start") else _refused(answers.get("map", {}))
    begins_s = rows[0].t_s if rows else 0.0
    why = [refused or _why_not(row, begins_s, wrong) for row in rows]
    spans = []
    for trusted, group in groupby(zip(rows, why, strict=True), key=lambda pair: not pair[1]):
        if trusted:
            held = [row.t_s for row, _ in group]
            spans.append((held[0], held[-1]))
    reasons = list(dict.fromkeys(reason for reason in why if reason))
    if not rows:
        reasons = ["no frame"]
    share = sum(not reason for reason in why) / max(len(rows), 1)
    return FlightVerdict(spans, share, reasons, [_named(fault) for _, fault in active.values()])


def verdict_of(folder: Path) -> FlightVerdict:
    """Of the record in a folder. Raises SourceError when there is none."""
    table = RowTable()
    faults: list[tuple[float, CalibrationFault]] = []
    verdicts: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for _, _, message in read_flight(folder):
        table.take(message)
        if isinstance(message, CalibrationFault):
            faults.append((message.t_ns / NS, message))
        elif isinstance(message, MeasurementVerdict):
            verdicts[message.measurement][str(message.verdict)] += 1
    return flight_verdict(list(table.rows.values()), faults, verdicts)


def _why_not(row: Row, begins_s: float, wrong: list[tuple[float, float, str]]) -> str:
    """Empty: the frame can be trusted."""
    for from_s, to_s, name in wrong:
        if from_s <= row.t_s < to_s:
            return name
    if not row.localised or row.sigma_e_m is None or row.sigma_n_m is None:
        return "no position"
    if math.hypot(row.sigma_e_m, row.sigma_n_m) / math.sqrt(2.0) > MAX_HORIZONTAL_SIGMA_M:
        return f"claims worse than {MAX_HORIZONTAL_SIGMA_M:.0f} m"
    age_ms = row.anchor_age_ms
    if age_ms is None or age_ms < 0:
        return "" if row.t_s - begins_s <= UNCONFIRMED_S else "no map match has confirmed the start"
    return "" if age_ms <= UNANCHORED_S * 1e3 else f"no map match for over {UNANCHORED_S:.0f} s"


def _since(alarm_s: float, fault: CalibrationFault, rows: Sequence[Row]) -> float:
    """From when a fault counts: what is described once was wrong from the beginning; a map that is found nowhere, since
    it was found last."""
    if fault.quantity != "registration":
        return -math.inf
    anchored = [row.t_s for row in rows if row.t_s <= alarm_s and row.anchor_age_ms == 0]
    return max(anchored, default=-math.inf) + 1e-9


def _refused(answers: Mapping[str, int]) -> str:
    refused, taken = answers.get(Verdict.INNOVATION, 0), answers.get(Verdict.ACCEPTED, 0)
    if refused + taken < LEAST_POSES or refused <= REFUSED_SHARE * (refused + taken):
        return ""
    return f"{refused} of {refused + taken} positions on the map were refused"


def _named(fault: CalibrationFault) -> str:
    return fault_words(fault).removesuffix(": no fix")
