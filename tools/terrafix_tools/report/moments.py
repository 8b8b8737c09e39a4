"""The worst moments of a flight, chosen from what the record itself says.

Candidates are of six kinds, in this order; within a kind the larger number is worse:

1. fix lost: GPS_INPUT without a 3D fix after the first one, frames without position after the first one, a search of
   the map [s];
2. calibration faults [s until their end];
3. links: the autopilot's link down, processes that died, were stuck or given up, gaps of GPS_INPUT [s];
4. error against the truth [m], if there is truth: above LARGE_ERROR_M or beyond 3 sigma of the claim;
5. gates: test ratio above 1; of a flight that can be trusted only a further reason, for a rejected measurement has done
   no harm there;
6. stated accuracy: the semi-major axis of the 95 % ellipse [m], where the link gives no fix for it.

The kinds take turns, each with its worst peak that is left, until MAX_MOMENTS are chosen. A peak is a candidate that no
worse one of its kind leads up to in steps of less than ``apart_s``: of a slowly decreasing radius only the beginning is
a moment. A candidate that is nearer than ``apart_s`` to a chosen moment is a further reason of that moment, one a
kind."""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from itertools import groupby, pairwise

import numpy as np

from terrafix.link.integrity.fix_type import MAX_HORIZONTAL_SIGMA_M
from terrafix.link.pilot_text.statustext import fault_text
from terrafix.messages import SearchStep
from terrafix_tools.estimates import NS
from terrafix_tools.pages.charts import clock
from terrafix_tools.report.data import FlightView, radius95_m
from terrafix_tools.report.text import FIX_3D, GAP_S, UNPLANNED

MAX_MOMENTS = 10
LARGE_ERROR_M = 20.0  # [spec: requirement on the share of the frames within 20 m]
CHI_95 = math.sqrt(5.991)  # radius of the 95 % ellipse in standard deviations [spec: chi-square, 2 degrees of freedom]
LARGE_RADIUS_M = CHI_95 * MAX_HORIZONTAL_SIGMA_M
APART_S = 10.0  # least time between two moments ...
APART_SHARE = 1 / 20  # ... or this share of a flight, if that is less
SEARCHING = (SearchStep.WIDEN, SearchStep.WHOLE_MAP, SearchStep.ASK)
MEASUREMENTS = {"map": "Map match", "attitude": "Reported heading", "height": "Reported height"}


@dataclass(frozen=True)
class Candidate:
    t_s: float
    size: float  # how bad, in the unit of its kind
    text: str


@dataclass
class Moment:
    """``reasons``: by kind, the first chosen one first. ``row``: index of the frame that is nearest in time."""

    t_s: float
    row: int
    frame_id: int
    reasons: dict[str, str] = field(default_factory=dict)


def worst_moments(view: FlightView, *, trusted: bool = False) -> list[Moment]:
    """Returns at most MAX_MOMENTS, in order of time; none of a flight in which nothing was bad. ``trusted``: the
    verdict on the flight."""
    apart_s = min(APART_S, APART_SHARE * view.duration_s)
    found_of = {kind: _worst_first(find(view)) for kind, find in _KINDS.items()}
    left = {kind: deque(peaks(found, apart_s)) for kind, found in found_of.items() if kind != "gate" or not trusted}
    times_s = np.array([row.t_s for row in view.rows])
    chosen: list[Moment] = []

    def take(kind: str, found: Candidate, only_reason: bool = False) -> bool:
        """-> whether it is a moment of its own"""
        near = min(chosen, key=lambda moment: abs(moment.t_s - found.t_s), default=None)
        if near is not None and abs(near.t_s - found.t_s) <= apart_s:
            near.reasons.setdefault(
                kind, found.text if found.t_s == near.t_s else f"{found.text} ({_clock(found.t_s)})"
            )
            return False
        if only_reason or len(chosen) == MAX_MOMENTS:
            return False
        row = int(np.argmin(np.abs(times_s - found.t_s)))
        frame_id = view.frame_ids[row] if row < len(view.frame_ids) else -1
        chosen.append(Moment(found.t_s, row, frame_id, {kind: found.text}))
        return True

    while len(chosen) < MAX_MOMENTS and any(left.values()):
        for kind, queue in left.items():
            while queue and not take(kind, queue.popleft()):
                pass
    for kind, candidates in found_of.items():
        for found in candidates:
            take(kind, found, only_reason=True)
    return sorted(chosen, key=lambda moment: moment.t_s)


def _worst_first(candidates: Iterable[Candidate]) -> list[Candidate]:
    known = [found for found in candidates if math.isfinite(found.size)]
    return sorted(known, key=lambda found: (-found.size, found.t_s))


def peaks(candidates: Iterable[Candidate], apart_s: float) -> Iterator[Candidate]:
    """``candidates``: the worst first. Yields those that are not within ``apart_s`` of a worse one."""
    worse_s: list[float] = []
    for found in candidates:
        i = bisect_left(worse_s, found.t_s)
        if all(abs(t - found.t_s) > apart_s for t in worse_s[max(0, i - 1) : i + 1]):
            yield found
        worse_s.insert(i, found.t_s)


def _errors(view: FlightView) -> Iterator[Candidate]:
    for row in view.rows:
        error_m, radius_m = view.error_m(row), radius95_m(row)
        beyond = radius_m is not None and error_m is not None and error_m > 3.0 / CHI_95 * radius_m
        if error_m is not None and (error_m > LARGE_ERROR_M or beyond):
            stated = f", stated 95 % radius {radius_m:.1f} m" if radius_m is not None else ""
            yield Candidate(row.t_s, error_m, f"Error {error_m:.1f} m against the truth{stated}")


def _lost(view: FlightView) -> Iterator[Candidate]:
    for from_s, to_s in _off((t, sent.fix_type >= FIX_3D) for t, sent in view.gps):
        why = next((sent.no_fix_reason for t, sent in view.gps if t >= from_s), "")
        yield Candidate(
            from_s, to_s - from_s, f"GPS_INPUT without a 3D fix for {_s(to_s - from_s)}: {why}".rstrip(": ")
        )
    for from_s, to_s in _off((row.t_s, row.localised) for row in view.rows):
        yield Candidate(from_s, to_s - from_s, f"No position for {_s(to_s - from_s)}")
    for (from_s, state), (to_s, _) in pairwise([*view.searches, (view.duration_s, None)]):
        if state is not None and state.step in SEARCHING:
            name = str(state.step).replace("_", " ")
            yield Candidate(from_s, to_s - from_s, f"Search of the map ({name}) for {_s(to_s - from_s)}")


def _faults(view: FlightView) -> Iterator[Candidate]:
    for i, (from_s, fault) in enumerate(view.faults):
        if fault.active:
            ends = (t for t, later in view.faults[i + 1 :] if later.quantity == fault.quantity and not later.active)
            text = f"{fault_text(fault).capitalize()}: {fault.detail}".rstrip(": ")
            yield Candidate(from_s, next(ends, view.duration_s) - from_s, text)


def _links(view: FlightView) -> Iterator[Candidate]:
    for from_s, to_s in _off((t, state.connected) for t, state in view.link_states):
        yield Candidate(from_s, to_s - from_s, f"Link to the autopilot down for {_s(to_s - from_s)}")
    for from_s, event in view.events:
        if event.event in UNPLANNED:
            back = (t for t, later in view.events if t > from_s and later.process == event.process)
            text = f"Process {event.process} {event.event.replace('_', ' ')}: {event.detail}".rstrip(": ")
            yield Candidate(from_s, next(back, view.duration_s) - from_s, text)
    for (from_s, _), (to_s, _) in pairwise(view.gps):
        if to_s - from_s > GAP_S:
            yield Candidate(from_s, to_s - from_s, f"No GPS_INPUT for {_s(to_s - from_s)}")


def _radii(view: FlightView) -> Iterator[Candidate]:
    for row in view.rows:
        radius_m = radius95_m(row)
        if radius_m is not None and radius_m > LARGE_RADIUS_M:
            yield Candidate(row.t_s, radius_m, f"Stated 95 % radius {radius_m:.1f} m")


def _gates(view: FlightView) -> Iterator[Candidate]:
    for measurement, innovations in view.innovations.items():
        for one in innovations.tested:
            if not one.accepted and one.test_ratio > 1.0:
                name = MEASUREMENTS.get(measurement, measurement.replace("_", " ").capitalize())
                text = f"{name} rejected, {one.test_ratio:.1f} times its gate: {one.detail}"
                yield Candidate((one.t_ns - view.zero_ns) / NS, one.test_ratio, text.rstrip(": "))


_KINDS: dict[str, Callable[[FlightView], Iterator[Candidate]]] = {
    "fix": _lost,
    "fault": _faults,
    "link": _links,
    "error": _errors,
    "gate": _gates,
    "accuracy": _radii,
}


def _off(samples: Iterable[tuple[float, bool]]) -> Iterator[tuple[float, float]]:
    """(time, state) -> intervals in which the state is False, after it was True once; the last one ends with the last
    sample."""
    seen, begin, last = False, None, 0.0
    for on, group in groupby(samples, key=lambda sample: sample[1]):
        times = [t for t, _ in group]
        if begin is not None:
            yield begin, times[0]
            begin = None
        if not on and seen:
            begin = times[0]
        seen, last = seen or on, times[-1]
    if begin is not None and last > begin:
        yield begin, last


def _clock(t_s: float) -> str:
    return f"at {clock(round(max(0.0, t_s)))}"


def _s(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 60 else f"{seconds / 60:.1f} min"
