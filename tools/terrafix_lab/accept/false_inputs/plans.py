"""Plans of scenarios with a false input ("lie"): its span and its edits."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from terrafix.core.node import Image
from terrafix_lab.accept.false_inputs import maps as lying_maps
from terrafix_lab.accept.flight import AcceptFlight
from terrafix_lab.accept.measuring.results import Marks
from terrafix_lab.accept.plan import Plan
from terrafix_lab.faults.edits import OriginEdit, Span, pause, photos, start_moved, unchanged_origin
from terrafix_lab.faults.fault import START
from terrafix_lab.faults.pictures import mirrored, replaced
from terrafix_lab.faults.table import SEED

MIN_FRAMES = 24  # of a flight, for frames before and after the lie
FOREIGN_ROW, FOREIGN_SHARE, INTERLEAVED = 10, 0.15, 30  # frames, share, frames
FAST = 3  # speed over that of the flight: successive pictures still overlap by two thirds
FAR_M = 150.0  # at least: more than a footprint, and three times the error of a false fix
START_ERROR_M = np.array([212.0, 212.0])  # 300 m
START_SIGMA_M = 50.0
PHOTO_M = 155.0
GAP_FRAMES, GAP_MORE_S = 16, 170.0


def _too_short(flight: AcceptFlight) -> str:
    return "" if len(flight.frame_refs) >= MIN_FRAMES else f"the flight has only {len(flight.frame_refs)} frames"


def _span(flight: AcceptFlight, first: int, last: int, text: str) -> Span:
    """From frame ``first`` to frame ``last``, both included; ``last`` is limited to the flight."""
    frame_refs = flight.frame_refs
    return Span(frame_refs[first].t_s, frame_refs[min(last, len(frame_refs) - 1)].t_s, text)


def _lying(span: Span, **plan: object) -> Plan:
    return Plan(marks=Marks(spans=(span,), lie=span), **plan)  # type: ignore[arg-type]


# --- pictures of another place ---


def _another_camera(flight: AcceptFlight, numbers: list[int], pace: int = 1) -> Plan | str:
    """The frames ``numbers`` show pictures of another camera, which match each other and not the map: the flight's own,
    half of its frames later, mirrored. They advance at ``pace`` times the speed of the flight."""
    if why := _too_short(flight):
        return why
    half = len(flight.frame_refs) // 2
    shown = {n: (numbers[0] + half + pace * (n - numbers[0])) % len(flight.frame_refs) for n in numbers}
    return _pictures_of(flight, shown, mirrored, "pictures of another place")


def _pictures_of(flight: AcceptFlight, shown: dict[int, int], change: Callable[[Image], Image], text: str) -> Plan:
    """``shown``: index of a frame -> index of the frame whose picture it shows."""

    def load(number: int) -> Image:
        return change(flight.picture(number))

    pictures = {flight.frame_refs[n].file: partial(load, other) for n, other in shown.items()}
    return _lying(_span(flight, min(shown), max(shown), text), edit=replaced(pictures))


def foreign_row(at: float = START, pace: int = 1) -> Callable[[AcceptFlight], Plan | str]:
    """From the share ``at`` of the frames on."""

    def plan(flight: AcceptFlight) -> Plan | str:
        start = flight.at(at)
        return _another_camera(flight, list(range(start, start + FOREIGN_ROW)), pace)

    return plan


def foreign_at_random(flight: AcceptFlight) -> Plan | str:
    drawn = np.random.default_rng([SEED, 70]).uniform(size=len(flight.frame_refs)) < FOREIGN_SHARE
    numbers = [int(n) for n in np.flatnonzero(drawn) if 0.1 <= n / len(flight.frame_refs) <= 0.8]
    return _another_camera(flight, numbers) if numbers else "too few frames to have a foreign one"


def interleaved(flight: AcceptFlight) -> Plan | str:
    start = flight.at(START)
    return _another_camera(flight, list(range(start, min(start + INTERLEAVED, flight.at(0.8)), 2)))


def elsewhere_reversed(flight: AcceptFlight) -> Plan | str:
    """Ten pictures of the flight itself, from another part of the map, in reverse order."""
    if why := _too_short(flight):
        return why
    track, start = flight.track_m(), flight.at(START)
    away = np.hypot(*(track - track[start]).T)
    away[: FOREIGN_ROW - 1] = np.nan  # the reverse sequence needs as many frames before it
    if not np.any(away >= FAR_M):
        return f"no two places of the flight are {FAR_M:.0f} m apart"
    far = int(np.nanargmax(away))
    return _pictures_of(flight, {start + k: far - k for k in range(FOREIGN_ROW)}, lambda i: i, "pictures of elsewhere")


# --- maps ---


def with_map(
    text: str,
    change: Callable[[AcceptFlight, Path, Path], str],
    origin: OriginEdit = unchanged_origin,
) -> Callable[[AcceptFlight], Plan | str]:
    """``change`` (flight, map of the flight, map to write) makes the map of the scenario."""

    def plan(flight: AcceptFlight) -> Plan | str:
        if not flight.has_raster_map:
            return "needs the map as a GeoTIFF, to change it"
        span = _span(flight, 0, len(flight.frame_refs) - 1, text)
        return _lying(span, other_map=partial(change, flight), origin=origin)

    return plan


def other_town(flight: AcceptFlight, given: Path, out: Path) -> str:
    if flight.other_map is not None:
        return lying_maps.put_in_place_of(flight.other_map, given, out)
    return lying_maps.mirrored(given, out)


def shifted_map(by_m: tuple[float, float], _: AcceptFlight, given: Path, out: Path) -> str:
    return lying_maps.shifted(given, out, *by_m)


def grown_map(flight: AcceptFlight, given: Path, out: Path) -> str:
    return lying_maps.scaled(
        given, out, 1.10, flight.truth[next(s.file for s in flight.frame_refs if s.file in flight.truth)]
    )


# --- start, and true inputs with gaps ---


def start_off(flight: AcceptFlight) -> Plan:
    """The lie is in the Origin only, so that its span is the first frame."""
    ahead = np.where(
        np.nanmean(flight.track_m(), axis=0) < 0.0, -1.0, 1.0
    )  # towards the centre of the flight, where the map is
    east_m, north_m = (ahead * START_ERROR_M).tolist()
    return _lying(_span(flight, 0, 0, "the start is 300 m off"), origin=start_moved(east_m, north_m, START_SIGMA_M))


def sparse_photos(flight: AcceptFlight) -> Plan | str:
    track = flight.track_m()
    chosen, last = [], None
    for number, place in enumerate(track):
        if np.isfinite(place).all() and (last is None or np.hypot(*(place - last)) >= PHOTO_M):
            chosen.append(flight.frame_refs[number].file)
            last = place
    return Plan(photos(frozenset(chosen))) if len(chosen) >= 6 else f"only {len(chosen)} photos {PHOTO_M:.0f} m apart"


def gap_of_minutes(flight: AcceptFlight) -> Plan | str:
    if why := _too_short(flight):
        return why
    first = flight.at(START)
    end = min(first + GAP_FRAMES, flight.at(0.7))
    span = Span(flight.frame_refs[first - 1].t_s, flight.frame_refs[end].t_s + GAP_MORE_S, "no frames, no telemetry")
    # The span ends before the first frame after the gap.
    gap = Span(span.from_s, span.to_s - 1e-3, span.text)
    return Plan(pause(first, end, GAP_MORE_S), marks=Marks(spans=(gap,)))
