"""Scenarios in which an input lies: the position must be right or withdrawn. In words: docs/acceptance.md.

The last group has true inputs that are scarce: there the position must stay good."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from terrafix.core.node import Image
from terrafix.messages import Origin
from terrafix_tools.accept import faults, lying_maps
from terrafix_tools.accept import lying_inputs as lying
from terrafix_tools.accept.criteria import EVERYWHERE, LASTING, PASSING
from terrafix_tools.accept.faults import Edit
from terrafix_tools.accept.flight import Flight
from terrafix_tools.accept.judged import Marks, Span
from terrafix_tools.accept.plan import Plan, Scenario

LEAST_FRAMES = 24  # of a flight: fewer leave nothing before the lie, or after it
FRAMES = 90  # of a generated flight: 45 s
SHORTEST = 2.5  # times the lie: a flight that has some time before it and after it
BEGINS = 0.4  # of the frames: where a lie begins that ends before the flight does
FOREIGN_ROW, FOREIGN_SHARE, INTERLEAVED = 10, 0.15, 30  # frames, share, frames
FAR_M = 350.0
FROZEN_S, FORGED_S, LATE_S = 15.0, 10.0, 1.0
BUFFERS = 4
MAP_SHIFT_M, SMALL_SHIFT_M = (212.0, -212.0), (100.0, 80.0)  # east, north: 300 m; 128 m, as between two datums
START_OFF_M = np.array([212.0, 212.0])  # 300 m
START_CLAIM_M = 50.0
PHOTO_M = 155.0
GAP_FRAMES, GAP_MORE_S = 16, 170.0
DROPPED, DOUBLED = 0.15, 0.15
SEED = 1  # of which frames are foreign, dropped or noisy


def _too_short(flight: Flight) -> str:
    return "" if len(flight.stops) >= LEAST_FRAMES else f"the flight has only {len(flight.stops)} frames"


def _span(flight: Flight, first: int, last: int, text: str) -> Span:
    """From this frame to that one, both in it; the last is the flight's at most."""
    stops = flight.stops
    return Span(stops[first].t_s, stops[min(last, len(stops) - 1)].t_s, text)


def _lying(span: Span, **plan: object) -> Plan:
    return Plan(marks=Marks(spans=(span,), lie=span), **plan)  # type: ignore[arg-type]


def _throughout(text: str, **plan: object) -> Callable[[Flight], Plan | str]:
    """The lie is there from the first frame to the last."""
    return lambda flight: _lying(_span(flight, 0, len(flight.stops) - 1, text), **plan)


def _for_seconds(seconds: float, text: str, edit: Callable[[Span], Edit]) -> Callable[[Flight], Plan | str]:
    """The lie begins after ``BEGINS`` of the frames and lasts so long."""

    def plan(flight: Flight) -> Plan | str:
        if flight.duration_s < SHORTEST * seconds:
            return f"the flight lasts only {flight.duration_s:.0f} s"
        from_s = flight.stops[flight.at(BEGINS)].t_s
        span = Span(from_s, from_s + seconds, text)
        return _lying(span, edit=edit(span))

    return plan


# --- pictures of another place ---


def _another_camera(flight: Flight, numbers: list[int]) -> Plan | str:
    """At the frames ``numbers`` another vehicle's camera is seen, whose pictures match each other and not the map: the
    flight's own from half of its frames later, mirrored."""
    if why := _too_short(flight):
        return why
    half = len(flight.stops) // 2
    shown = {n: (n + half) % len(flight.stops) for n in numbers}
    return _pictures_of(flight, shown, lying.mirrored, "pictures of another place")


def _pictures_of(flight: Flight, shown: dict[int, int], change: Callable[[Image], Image], text: str) -> Plan:
    """``shown``: by number of the frame, the number of the frame whose picture it shows."""

    def load(number: int) -> Image:
        return change(flight.picture(number))

    pictures = {flight.stops[n].file: partial(load, other) for n, other in shown.items()}
    return _lying(_span(flight, min(shown), max(shown), text), edit=lying.replaced(pictures))


def _foreign_row(flight: Flight) -> Plan | str:
    begins = flight.at(BEGINS)
    return _another_camera(flight, list(range(begins, begins + FOREIGN_ROW)))


def _foreign_start(flight: Flight) -> Plan | str:
    return _another_camera(flight, list(range(FOREIGN_ROW)))


def _foreign_at_random(flight: Flight) -> Plan | str:
    drawn = np.random.default_rng([SEED, 70]).uniform(size=len(flight.stops)) < FOREIGN_SHARE
    numbers = [int(n) for n in np.flatnonzero(drawn) if 0.1 <= n / len(flight.stops) <= 0.8]
    return _another_camera(flight, numbers) if numbers else "too few frames to have a foreign one"


def _interleaved(flight: Flight) -> Plan | str:
    begins = flight.at(BEGINS)
    return _another_camera(flight, list(range(begins, min(begins + INTERLEAVED, flight.at(0.8)), 2)))


def _elsewhere_reversed(flight: Flight) -> Plan | str:
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


def _map(
    text: str, change: Callable[[Flight, Path, Path], str], origin: Callable[[Origin], Origin] = faults.same_origin
) -> Callable[[Flight], Plan | str]:
    """``change`` (flight, map of the flight, map to write) makes the map that is flown with."""

    def plan(flight: Flight) -> Plan | str:
        if not flight.has_raster_map:
            return "needs the map as a GeoTIFF, to change it"
        span = _span(flight, 0, len(flight.stops) - 1, text)
        return _lying(span, other_map=partial(change, flight), origin=origin)

    return plan


def _other_town(flight: Flight, given: Path, out: Path) -> str:
    if flight.other_map is not None:
        return lying_maps.put_in_place_of(flight.other_map, given, out)
    return lying_maps.mirrored(given, out)


def _shifted(by_m: tuple[float, float], _: Flight, given: Path, out: Path) -> str:
    return lying_maps.shifted(given, out, *by_m)


def _grown(flight: Flight, given: Path, out: Path) -> str:
    return lying_maps.scaled(
        given, out, 1.10, flight.truth[next(s.file for s in flight.stops if s.file in flight.truth)]
    )


# --- start, and scarce inputs that are true ---


def _start_off(flight: Flight) -> Plan:
    """The lie is told once, before the first frame."""
    ahead = np.where(np.nanmean(flight.track_m(), axis=0) < 0.0, -1.0, 1.0)  # towards the middle: the map is there
    east_m, north_m = (ahead * START_OFF_M).tolist()
    return _lying(
        _span(flight, 0, 0, "the start is 300 m off"), origin=faults.start_moved(east_m, north_m, START_CLAIM_M)
    )


def _photos(flight: Flight) -> Plan | str:
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


def _gap(flight: Flight) -> Plan | str:
    if why := _too_short(flight):
        return why
    first = flight.at(BEGINS)
    end = min(first + GAP_FRAMES, flight.at(0.7))
    span = Span(flight.stops[first - 1].t_s, flight.stops[end].t_s + GAP_MORE_S, "no frames, no telemetry")
    # The first frame after it is the first that counts.
    before = Span(span.from_s, span.to_s - 1e-3, span.text)
    return Plan(lying.pause(first, end, GAP_MORE_S), marks=Marks(spans=(before,)))


def _true(
    edit: Edit = faults.same, origin: Callable[[Origin], Origin] = faults.same_origin
) -> Callable[[Flight], Plan]:
    return lambda _: Plan(edit, origin)


SCARCE = (*EVERYWHERE, "claim width")
HEIGHTS = (
    ("height 30 % low", "The reported height is 30 % too small, and stated as good.", 0.7),
    ("height 30 % high", "The reported height is 30 % too large, and stated as good.", 1.3),
    ("height in feet", "The reported height is in feet where metres are expected.", lying.FEET_IN_A_METRE),
    ("height taken for feet", "The reported height was divided by 3.28 once too often.", 1.0 / lying.FEET_IN_A_METRE),
)
LIES: tuple[Scenario, ...] = (
    Scenario("ten foreign frames", "Ten frames in a row show another place.", PASSING, _foreign_row, frames=FRAMES),
    Scenario(
        "foreign frames at the start", "The first ten frames show another place.", PASSING, _foreign_start,
        frames=FRAMES),
    Scenario(
        "15 % foreign frames", "At random, 15 % of the frames are of another vehicle's camera.", PASSING,
        _foreign_at_random, frames=FRAMES),
    Scenario(
        "every second frame foreign", "Two cameras by turns, one of them at another place, for 30 frames.", PASSING,
        _interleaved, frames=FRAMES),
    Scenario(
        "elsewhere in reverse", "Ten frames of another part of the map, in reverse order.", PASSING,
        _elsewhere_reversed, frames=FRAMES),
    Scenario(
        "another town's map", "The map is of another town; the start claims 50 m.", LASTING,
        _map("the map is of another town", _other_town, lying.start_claims(START_CLAIM_M)), frames=FRAMES),
    Scenario(
        "another town's map, no start", "The map is of another town, and no start is known.", LASTING,
        _map("the map is of another town", _other_town, lying.start_unknown), frames=FRAMES),
    Scenario(
        "map shifted by 300 m", "The coordinates of the map are off by 300 m.", LASTING,
        _map("the map is shifted", partial(_shifted, MAP_SHIFT_M)), frames=FRAMES),
    Scenario(
        "map in another datum", "The coordinates of the map are off by 128 m.", LASTING,
        _map("the map is shifted", partial(_shifted, SMALL_SHIFT_M)), frames=FRAMES),
    Scenario(
        "map 10 % too large", "The scale of the map is wrong.", LASTING, _map("too large", _grown), frames=FRAMES),
    Scenario(
        "start 300 m off", "The start is 300 m off and claims 50 m.", PASSING, _start_off, frames=FRAMES),
    *(
        Scenario(
            f"heading {off} degrees off", f"The reported heading is off by {off} degrees throughout.", LASTING,
            _throughout("the heading is off", edit=faults.yaw_plus(off)), frames=FRAMES)
        for off in (90, 180)
    ),
    *(
        Scenario(
            f"camera mounted {word}", f"The camera is turned by {off} degrees, and the description does not say so.",
            LASTING, _throughout("the mount is not as described", origin=lying.mount_yaw_plus(off)), frames=FRAMES)
        for word, off in (("sideways", 90.0), ("backwards", 180.0))
    ),
    Scenario(
        "mirrored pictures", "Left and right are exchanged in every picture.", LASTING,
        _throughout("mirrored", edit=lying.every_picture(lying.mirrored)), frames=FRAMES),
    Scenario(
        "roll and pitch swapped", "Roll is reported as pitch, and pitch as roll.", LASTING,
        _throughout("swapped", edit=faults.telemetry(lying.roll_pitch_swapped)), frames=FRAMES),
    Scenario(
        "roll and pitch negated", "Roll and pitch are reported with the wrong sign.", LASTING,
        _throughout("of wrong sign", edit=faults.telemetry(lying.roll_pitch_negated)), frames=FRAMES),
    *(
        Scenario(
            name, promise, LASTING, _throughout("the height is wrong", edit=faults.height_times(factor)), frames=FRAMES)
        for name, promise, factor in HEIGHTS
    ),
    *(
        Scenario(
            f"focal length {word}", f"The focal length is {word} in the description, and stated to 1 %.", LASTING,
            _throughout("the focal length is wrong", origin=lying.focal_times(factor)), frames=FRAMES)
        for word, factor in (("halved", 0.5), ("doubled", 2.0))
    ),
    Scenario(
        "frozen picture with noise", "The camera repeats one picture for 15 s, with new noise each time.", PASSING,
        _for_seconds(FROZEN_S, "frozen", lambda span: lying.stale_buffers(
            span, 1, noise_grey=lying.NOISE_GREY, seed=SEED)), frames=FRAMES),
    Scenario(
        "four stale buffers", "The camera repeats four pictures in turn for 15 s.", PASSING,
        _for_seconds(FROZEN_S, "stale", lambda span: lying.stale_buffers(
            span, BUFFERS, noise_grey=lying.NOISE_GREY, seed=SEED)), frames=FRAMES),
    Scenario(
        "pictures 1 s late", "Every picture is a second old when it gets its time.", (*LASTING, "late sure over 20 m"),
        _throughout("late", edit=lying.late_pictures(LATE_S)), frames=FRAMES),
    Scenario(
        "forged tilt", "For 10 s a roll is reported that is 15 degrees more than the true one.", PASSING,
        _for_seconds(FORGED_S, "forged", lambda span: lying.forged(span, lying.rolled(15.0))), frames=FRAMES),
    Scenario(
        "forged heading", "For 10 s the reported heading jumps by 90 degrees.", PASSING,
        _for_seconds(FORGED_S, "forged", lambda span: lying.forged(span, faults.turned(90.0))), frames=FRAMES),
    Scenario(
        "dropped and doubled frames", "15 % of the frames are missing, 15 % come twice.", SCARCE,
        _true(lying.dropped_and_doubled(DROPPED, DOUBLED, SEED)), frames=FRAMES),
    Scenario(
        "photos every 155 m", "Photos that share little ground, and nothing between them.", SCARCE, _photos,
        frames=400),
    Scenario(
        "gap of minutes", "No frame and no telemetry for three minutes.", (*SCARCE, "recovery"), _gap, frames=FRAMES),
    Scenario(
        "height unknown", "No height is reported.", SCARCE, _true(faults.telemetry(lying.height_unknown)),
        frames=FRAMES),
    Scenario(
        "start unknown", "No start is known.", (*SCARCE, "first position"), _true(origin=lying.start_unknown),
        frames=FRAMES),
)  # fmt: skip
