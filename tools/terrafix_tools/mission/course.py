"""Generates a mission from a seed: a closed course of a given length inside a box, in as many laps as needed."""

import math
from dataclasses import replace

import numpy as np

from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mission.items import AltitudeFrame, Box, Do, Item, Mission

LEG_M = 380.0  # approximate leg length; a fixed wing needs room to turn
MIN_LEG_M = 120.0
CORNERS = (4, 12)
MAX_INDENT = 0.45  # largest radial displacement of a corner inwards, as a share of the radius
CORNER_FACTOR = 1.06  # the course is longer by this factor, since rounded corners shorten the flown distance
# height lost per metre to the landing: half of what a glide can lose, which leaves a margin for falling ground
APPROACH_SLOPE = 0.05


def course(
    seed: int,
    length_m: float,
    box: Box,
    frame: LocalFrame,
    *,
    agl_m: float,
    from_ground: bool = False,
) -> Mission:
    """Returns the mission. ``box``: bounds of the corners. ``from_ground``: with take-off and landing at the first
    corner.

    Raises UsageError when the box is too small or the length is not positive.
    """
    if not length_m > 0.0 or not math.isfinite(length_m):
        raise UsageError(f"--length-km {length_m / 1e3:g}: choose a positive length")
    centre = np.array([(box.west_m + box.east_m) / 2, (box.south_m + box.north_m) / 2])
    half_size = np.array([(box.east_m - box.west_m) / 2, (box.north_m - box.south_m) / 2])
    if half_size.min() < MIN_LEG_M / 2:
        width_m, high_m = (max(0.0, 2.0 * float(v)) for v in half_size)
        raise UsageError(
            f"the world has {width_m:.0f} m x {high_m:.0f} m to fly in, a course needs {MIN_LEG_M:.0f} m; "
            "give a larger image, or fly lower with --agl"
        )
    lap_m = 2.0 * math.pi * math.sqrt(float((half_size**2).mean())) * (1.0 - MAX_INDENT / 2)
    laps = math.ceil(length_m / lap_m)
    count = int(np.clip(round(min(lap_m, length_m / laps) / LEG_M), *CORNERS))
    shape = _shape(np.random.default_rng([seed, 41]), laps, count) * half_size
    shape *= min(1.0, CORNER_FACTOR * length_m / float(np.hypot(*np.diff(shape, axis=0).T).sum()))
    return _mission(centre + shape, frame, agl_m, f"course of seed {seed}", from_ground)


def _shape(rng: np.random.Generator, laps: int, count: int) -> np.ndarray:
    """Returns the corners (N, 2), on and within the unit circle, closed."""
    turn = np.arange(laps * count) + rng.uniform(-0.2, 0.2, laps * count)
    angle = rng.uniform(0.0, 2.0 * math.pi) + 2.0 * math.pi * turn / count
    corners = np.column_stack([np.sin(angle), np.cos(angle)]) * (1.0 - MAX_INDENT * rng.uniform(size=(laps * count, 1)))
    return np.vstack([corners, corners[:1]])


def _mission(corners: np.ndarray, frame: LocalFrame, agl_m: float, name: str, from_ground: bool) -> Mission:
    places = [frame.to_wgs84(float(e), float(n)) for e, n in corners]
    items = [
        Item(Do.WAYPOINT, i, lat, lon, agl_m, AltitudeFrame.GROUND) for i, (lat, lon) in enumerate(places, start=1)
    ]
    if from_ground:
        legs_m = np.hypot(*np.diff(corners, axis=0).T)
        to_go_m = np.cumsum(legs_m[::-1])[::-1]
        approach = [
            replace(item, height_m=min(agl_m, APPROACH_SLOPE * float(to_go)))
            for item, to_go in zip(items[1:-1], to_go_m[1:], strict=True)
        ]
        items = [Item(Do.TAKE_OFF, 1, height_m=agl_m), *approach, Item(Do.LAND, len(items), *places[-1])]
    return Mission(name, *places[0], tuple(items))
