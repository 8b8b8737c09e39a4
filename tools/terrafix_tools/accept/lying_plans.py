"""How a flight becomes a scenario in which an input lies: when the lie begins and ends, and what is done meanwhile."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from terrafix.core.node import Image
from terrafix.messages import Origin
from terrafix_tools.accept import faults, lying_maps
from terrafix_tools.accept import lying_inputs as lying
from terrafix_tools.accept.faults import Edit
from terrafix_tools.accept.flight import Flight
from terrafix_tools.accept.judged import Marks, Span
from terrafix_tools.accept.plan import Plan

LEAST_FRAMES = 24  # of a flight: fewer leave nothing before the lie, or after it
SHORTEST = 2.5  # times the lie: a flight that has some time before it and after it
BEGINS = 0.4  # of the frames: where a lie begins that ends before the flight does
FOREIGN_ROW, FOREIGN_SHARE, INTERLEAVED = 10, 0.15, 30  # frames, share, frames
FAST = 3  # times the flight: its pictures still share two thirds of their ground
FAR_M = 150.0  # at least: what a frame sees, and three times what makes a false fix
START_OFF_M = np.array([212.0, 212.0])  # 300 m
START_CLAIM_M = 50.0
PHOTO_M = 155.0
GAP_FRAMES, GAP_MORE_S = 16, 170.0
SEED = 1  # of which frames are foreign, dropped or noisy


def _too_short(flight: Flight) -> str:
    return "" if len(flight.stops) >= LEAST_FRAMES else f"the flight has only {len(flight.stops)} frames"


def _span(flight: Flight, first: int, last: int, text: str) -> Span:
    """From this frame to that one, both in it; the last is the flight's at most."""
    stops = flight.stops
    return Span(stops[first].t_s, stops[min(last, len(stops) - 1)].t_s, text)


def _lying(span: Span, **plan: object) -> Plan:
    return Plan(marks=Marks(spans=(span,), lie=span), **plan)  # type: ignore[arg-type]


def throughout(text: str, **plan: object) -> Callable[[Flight], Plan | str]:
    """The lie is there from the first frame to the last."""
    return lambda flight: _lying(_span(flight, 0, len(flight.stops) - 1, text), **plan)


def for_seconds(seconds: float, text: str, edit: Callable[[Span], Edit]) -> Callable[[Flight], Plan | str]:
    """The lie begins after ``BEGINS`` of the frames and lasts so long."""

    def plan(flight: Flight) -> Plan | str:
        if flight.duration_s < SHORTEST * seconds:
            return f"the flight lasts only {flight.duration_s:.0f} s"
        from_s = flight.stops[flight.at(BEGINS)].t_s
        span = Span(from_s, from_s + seconds, text)
        return _lying(span, edit=edit(span))

    return plan


# --- pictures of another place ---


def _another_camera(flight: Flight, numbers: list[int], pace: int = 1) -> Plan | str:
    """At the frames ``numbers`` another vehicle's camera is seen, whose pictures match each other and not the map: the
    flight's own from half of its frames later, mirrored. It flies ``pace`` times as fast as the flight."""
    if why := _too_short(flight):
        return why
    half = len(flight.stops) // 2
    shown = {n: (numbers[0] + half + pace * (n - numbers[0])) % len(flight.stops) for n in numbers}
    return _pictures_of(flight, shown, lying.mirrored, "pictures of another place")


def _pictures_of(flight: Flight, shown: dict[int, int], change: Callable[[Image], Image], text: str) -> Plan:
    """``shown``: by number of the frame, the number of the frame whose picture it shows."""

    def load(number: int) -> Image:
        return change(flight.picture(number))

    pictures = {flight.stops[n].file: partial(load, other) for n, other in shown.items()}
    return _lying(_span(flight, min(shown), max(shown), text), edit=lying.replaced(pictures))


def foreign_row(flight: Flight) -> Plan | str:
    begins = flight.at(BEGINS)
    return _another_camera(flight, list(range(begins, begins + FOREIGN_ROW)))


def fast_foreign_row(flight: Flight) -> Plan | str:
    begins = flight.at(BEGINS)
    return _another_camera(flight, list(range(begins, begins + FOREIGN_ROW)), FAST)


def foreign_start(flight: Flight) -> Plan | str:
    return _another_camera(flight, list(range(FOREIGN_ROW)))


def foreign_at_random(flight: Flight) -> Plan | str:
    drawn = np.random.default_rng([SEED, 70]).uniform(size=len(flight.stops)) < FOREIGN_SHARE
    numbers = [int(n) for n in np.flatnonzero(drawn) if 0.1 <= n / len(flight.stops) <= 0.8]
    return _another_camera(flight, numbers) if numbers else "too few frames to have a foreign one"


def interleaved(flight: Flight) -> Plan | str:
    begins = flight.at(BEGINS)
    return _another_camera(flight, list(range(begins, min(begins + INTERLEAVED, flight.at(0.8)), 2)))


def elsewhere_reversed(flight: Flight) -> Plan | str:
    """Ten pictures of the flight itself, from another part of the map and in reverse order."""
    if why := _too_short(flight):
        return why
    track, begins = flight.track_m(), flight.at(BEGINS)
    away = np.hypot(*(track - track[begins]).T)
    away[: FOREIGN_ROW - 1] = np.nan  # as many come before it, and are shown after it
    if not np.any(away >= FAR_M):
        return f"no two places of the flight are {FAR_M:.0f} m apart"
    far = int(np.nanargmax(away))
    return _pictures_of(flight, {begins + k: far - k for k in range(FOREIGN_ROW)}, lambda i: i, "pictures of elsewhere")


# --- maps ---


def with_map(
    text: str, change: Callable[[Flight, Path, Path], str], origin: Callable[[Origin], Origin] = faults.same_origin
) -> Callable[[Flight], Plan | str]:
    """``change`` (flight, map of the flight, map to write) makes the map that is flown with."""

    def plan(flight: Flight) -> Plan | str:
        if not flight.has_raster_map:
            return "needs the map as a GeoTIFF, to change it"
        span = _span(flight, 0, len(flight.stops) - 1, text)
        return _lying(span, other_map=partial(change, flight), origin=origin)

    return plan


def other_town(flight: Flight, given: Path, out: Path) -> str:
    if flight.other_map is not None:
        return lying_maps.put_in_place_of(flight.other_map, given, out)
    return lying_maps.mirrored(given, out)


def shifted_map(by_m: tuple[float, float], _: Flight, given: Path, out: Path) -> str:
    return lying_maps.shifted(given, out, *by_m)


def grown_map(flight: Flight, given: Path, out: Path) -> str:
    return lying_maps.scaled(
        given, out, 1.10, flight.truth[next(s.file for s in flight.stops if s.file in flight.truth)]
    )


# --- start, and scarce inputs that are true ---


def start_off(flight: Flight) -> Plan:
    """The lie is told once, before the first frame."""
    ahead = np.where(np.nanmean(flight.track_m(), axis=0) < 0.0, -1.0, 1.0)  # towards the middle: the map is there
    east_m, north_m = (ahead * START_OFF_M).tolist()
    return _lying(
        _span(flight, 0, 0, "the start is 300 m off"), origin=faults.start_moved(east_m, north_m, START_CLAIM_M)
    )


def sparse_photos(flight: Flight) -> Plan | str:
    track = flight.track_m()
    chosen, last = [], None
    for number, place in enumerate(track):
        if np.isfinite(place).all() and (last is None or np.hypot(*(place - last)) >= PHOTO_M):
            chosen.append(flight.stops[number].file)
            last = place
    return (
        Plan(lying.photos(frozenset(chosen)))
        if len(chosen) >= 6
        else f"only {len(chosen)} photos {PHOTO_M:.0f} m apart"
    )


def gap_of_minutes(flight: Flight) -> Plan | str:
    if why := _too_short(flight):
        return why
    first = flight.at(BEGINS)
    end = min(first + GAP_FRAMES, flight.at(0.7))
    span = Span(flight.stops[first - 1].t_s, flight.stops[end].t_s + GAP_MORE_S, "no frames, no telemetry")
    # The first frame after it is the first that counts.
    before = Span(span.from_s, span.to_s - 1e-3, span.text)
    return Plan(lying.pause(first, end, GAP_MORE_S), marks=Marks(spans=(before,)))


def true_inputs(
    edit: Edit = faults.same, origin: Callable[[Origin], Origin] = faults.same_origin
) -> Callable[[Flight], Plan]:
    return lambda _: Plan(edit, origin)
