"""Mission check: where the path leaves the map, and where no fixes are expected."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.check.sight import MatchabilityProbe, Sight
from terrafix_tools.mission.items import POSITIONED, AltitudeFrame, Do, Mission

STEP_M = 20.0  # distance of the sample points of the path
MAX_SIGHT_POINTS = 200  # points of the path at which frames are placed: some twenty seconds
CIRCLE_POINTS = 24


@dataclass(frozen=True)
class Stretch:
    """A part of the path: start and end (latitude, longitude in degrees), and the preceding mission item."""

    start: tuple[float, float]
    end: tuple[float, float]
    length_m: float
    after_item: int  # its index in the file; 0 = home


@dataclass(frozen=True)
class MissionRoute:
    """Points along a mission, about STEP_M apart: local metres (N, 2), and the preceding item of each one (N,)."""

    points_m: np.ndarray
    after_item: np.ndarray
    frame: LocalFrame

    @property
    def along_m(self) -> np.ndarray:
        """(N,) distance from the start in metres."""
        steps = np.hypot(*np.diff(self.points_m, axis=0).T) if len(self.points_m) > 1 else np.zeros(0)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def stretches(self, chosen: np.ndarray) -> list[Stretch]:
        """Runs of chosen (N,) points, longest first. A run extends half a step beyond its first and last point."""
        edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
        along_m = self.along_m
        middles = np.concatenate([along_m[:1], (along_m[1:] + along_m[:-1]) / 2, along_m[-1:]])
        found = [
            Stretch(
                self.frame.to_wgs84(*self.points_m[first]),
                self.frame.to_wgs84(*self.points_m[end - 1]),
                float(middles[end] - middles[first]),
                int(self.after_item[first]),
            )
            for first, end in zip(edges[::2], edges[1::2], strict=True)
        ]
        return sorted(found, key=lambda stretch: -stretch.length_m)


def mission_route(mission: Mission, frame: LocalFrame) -> MissionRoute:
    """Home, the items in order, circles for loiter items with a radius, and home again after a return item."""
    corners = [(frame.to_local(mission.home_lat_deg, mission.home_lon_deg), 0)]
    if not mission.starts_on_ground():
        corners = []
    for item in mission.items:
        if item.do is Do.RETURN:
            corners.append((frame.to_local(mission.home_lat_deg, mission.home_lon_deg), item.number))
        elif item.lat_deg is not None and item.lon_deg is not None:
            e_m, n_m = frame.to_local(item.lat_deg, item.lon_deg)
            corners.append(((e_m, n_m), item.number))
            if item.do in POSITIONED and item.do is not Do.WAYPOINT and item.radius_m:
                corners += [((e_m + de, n_m + dn), item.number) for de, dn in _circle(abs(item.radius_m))]
    points, after = [corners[0][0]], [corners[0][1]]
    for (start, number), (end, _) in pairwise(corners):
        count = max(1, math.ceil(math.dist(start, end) / STEP_M))
        for k in range(1, count + 1):
            points.append((start[0] + (end[0] - start[0]) * k / count, start[1] + (end[1] - start[1]) * k / count))
            after.append(number)
    return MissionRoute(np.array(points), np.array(after), frame)


def uncovered(route: MissionRoute, package: MapPackage, layer: str) -> np.ndarray:
    """(N,) bool: points over which the layer has no valid pixel."""
    return np.array([not package.covers(*route.frame.to_wgs84(e_m, n_m), layer) for e_m, n_m in route.points_m])


def sight_along(route: MissionRoute, probe: MatchabilityProbe) -> np.ndarray:
    """(N,) uint8 of Sight, computed at no more than MAX_SIGHT_POINTS points; other points take the nearest result."""
    every = max(1, math.ceil(len(route.points_m) / MAX_SIGHT_POINTS))
    sampled = np.arange(0, len(route.points_m), every)
    seen = np.array([probe.at(*route.points_m[i]) for i in sampled], np.uint8)
    return seen[np.minimum((np.arange(len(route.points_m)) + every // 2) // every, len(sampled) - 1)]


def height_of(mission: Mission) -> float | None:
    """Median height above home or ground of the mission's items, metres; None when all heights are AMSL."""
    heights = [
        i.height_m
        for i in mission.items
        if i.height_m and i.altitude_frame is not AltitudeFrame.SEA and i.do in POSITIONED
    ]
    return float(np.median(heights)) if heights else None


def _circle(radius_m: float) -> Iterable[tuple[float, float]]:
    for k in range(CIRCLE_POINTS + 1):
        angle = 2 * math.pi * k / CIRCLE_POINTS
        yield radius_m * math.cos(angle), radius_m * math.sin(angle)


def blind(sight: np.ndarray) -> np.ndarray:
    """(N,) bool: points without an expected fix."""
    return (sight == Sight.BLIND) | (sight == Sight.NO_MAP)
