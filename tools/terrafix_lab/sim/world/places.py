"""Trees, villages and farms of a generated place."""

import itertools
import math

import cv2
import numpy as np

from terrafix_lab.sim.world.season import SEASONS
from terrafix_lab.sim.world.shapes import House, Line, Parcel, PlanWarp, densify, divide, long_axis

LOT_AREA_M2 = (700.0, 1_300.0)  # a house with its garden
TREE_SPACING_M = 6.5  # in a wood
HOUSE_SHARE = 0.85  # share of the lots with a house
PERMANENT_SHARE = 0.88  # share of the houses that exist at both dates


def trees_at(rng: np.random.Generator, points: np.ndarray, kind: int | np.ndarray) -> np.ndarray:
    """Converts (N, 2) positions to (N, 6): the columns of Cell.trees."""
    kinds = np.broadcast_to(np.asarray(kind), len(points))
    radius = rng.uniform(0.75, 1.3, len(points)) * np.array([3.6, 2.6, 2.0, 1.3])[kinds]
    height = rng.uniform(0.8, 1.2, len(points)) * np.array([11.0, 14.0, 4.0, 2.0])[kinds]
    return np.column_stack([points, radius, height, kinds, rng.random(len(points))])


def _grid_in(rng: np.random.Generator, outline: np.ndarray, angle: float, step_m: float, jitter_m: float) -> np.ndarray:
    """Returns points of a jittered grid inside an outline (N, 2)."""
    centre = outline.mean(axis=0)
    reach = float(np.hypot(*(outline - centre).T).max())
    ticks = np.arange(-reach, reach, step_m)
    grid = np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)
    c, s = math.cos(angle), math.sin(angle)
    points = grid @ np.array([[c, s], [-s, c]]) + centre + rng.normal(0.0, jitter_m, grid.shape)
    contour = outline.astype(np.float32)
    inside = [cv2.pointPolygonTest(contour, (float(x), float(y)), False) > 0 for x, y in points]
    return points[np.array(inside, dtype=bool)]


def wood(rng: np.random.Generator, outline: np.ndarray) -> np.ndarray:
    points = _grid_in(rng, outline, rng.uniform(0, math.pi), TREE_SPACING_M, TREE_SPACING_M / 3)
    conifers = rng.uniform(0.0, 0.8)
    return trees_at(rng, points, (rng.random(len(points)) < conifers).astype(int))


def orchard(rng: np.random.Generator, outline: np.ndarray, angle: float) -> np.ndarray:
    points = _grid_in(rng, outline, angle, 9.0, 0.4)
    return trees_at(rng, points[rng.random(len(points)) < 0.88], 2)


def scattered(rng: np.random.Generator, outline: np.ndarray, per_ha: float) -> np.ndarray:
    """Single trees and bushes in a field, partly in small groups."""
    low, high = outline.min(axis=0), outline.max(axis=0)
    count = rng.poisson(per_ha * float(np.prod(high - low)) / 1e4)
    places = rng.uniform(low, high, (count, 2))
    groups = rng.integers(1, 4, count)
    spots = np.repeat(places, groups, axis=0) + rng.normal(0.0, 4.0, (int(groups.sum()), 2))
    contour = outline.astype(np.float32)
    inside = np.array([cv2.pointPolygonTest(contour, (float(x), float(y)), False) > 0 for x, y in spots], dtype=bool)
    return trees_at(rng, spots[inside], rng.choice([0, 1, 3, 3], int(inside.sum())))


def row_of_trees(rng: np.random.Generator, points: np.ndarray, width_m: float) -> np.ndarray:
    """A hedge or an avenue along a line."""
    side = width_m / 2 + 2.5
    spots = []
    for start, end in itertools.pairwise(points):
        length = max(float(np.hypot(*(end - start))), 1e-6)
        normal = np.array([start[1] - end[1], end[0] - start[0]]) / length
        for along in np.arange(0.0, length, 5.0):
            spots.append(start + (end - start) * along / length + normal * side)
    place = np.array(spots) + rng.normal(0.0, 0.8, (len(spots), 2))
    return trees_at(rng, place[rng.random(len(place)) < 0.8], rng.choice([0, 0, 3, 3, 3], len(place))[0])


def village(
    rng: np.random.Generator,
    shape: np.ndarray,
    warp: PlanWarp,
    lots: list[Parcel],
    lines: list[Line],
    houses: list[House],
    trees: list[np.ndarray],
) -> None:
    cuts: list[tuple[int, np.ndarray]] = []
    for lot in divide(rng, shape, LOT_AREA_M2, cuts):
        outline = warp(lot)
        angle = long_axis(outline) + (math.pi / 2 if rng.random() < 0.3 else 0.0)
        lots.append(Parcel(outline, "garden", angle, int(rng.integers(1 << 31))))
        centre = outline.mean(axis=0)
        if rng.random() < HOUSE_SHARE:
            size = (rng.uniform(9.0, 15.0), rng.uniform(7.0, 10.0))
            changed = rng.random() >= PERMANENT_SHARE
            absent = (
                tuple(str(n) for n in rng.choice(list(SEASONS), len(SEASONS) // 2, replace=False)) if changed else ()
            )
            place = centre + rng.normal(0.0, 2.0, 2)
            roof = int(rng.integers(0, 6))
            key = int(rng.integers(1 << 31))
            houses.append(House((place[0], place[1]), *size, angle, rng.uniform(5.0, 8.0), roof, key, absent))
        spots = outline + (centre - outline) * rng.uniform(0.15, 0.35, (len(outline), 1))
        trees.append(trees_at(rng, spots[rng.random(len(spots)) < 0.45], int(rng.choice([0, 2, 3]))))
    for depth, cut in cuts:
        if depth < 2:
            lines.append(Line(warp(densify(cut)), "street", 4.5, int(rng.integers(1 << 31))))


def farms(rng: np.random.Generator, lines: list[Line], houses: list[House], lots: list[Parcel], count: int) -> None:
    """A few yards with large barns next to tracks."""
    tracks = [line for line in lines if line.kind == "track" and len(line.points_m) > 4]
    for index in rng.choice(len(tracks), min(count, len(tracks)), replace=False):
        points = tracks[index].points_m
        middle = len(points) // 2
        along = points[middle] - points[middle - 1]
        angle = math.atan2(along[1], along[0])
        ex, ey = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
        yard = points[middle] + ey * 28.0
        corners = np.array([yard + ex * a + ey * b for a, b in ((-32, -25), (32, -25), (32, 25), (-32, 25))])
        lots.append(Parcel(corners, "yard", angle, int(rng.integers(1 << 31))))
        for at, size, turn in (
            ((-15, 9), (34.0, 15.0), 0.0),
            ((20, -2), (26.0, 13.0), 1.0),
            ((-16, -14), (14.0, 10.0), 0.0),
        ):
            place = yard + ex * at[0] + ey * at[1]
            turned = angle + turn * math.pi / 2
            roof, key = int(rng.integers(3, 8)), int(rng.integers(1 << 31))
            houses.append(House((place[0], place[1]), *size, turned, rng.uniform(6.0, 9.0), roof, key))
