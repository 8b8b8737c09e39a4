"""The plan of a generated place: who owns which field, where roads, water, houses and trees are. No pixels.

Coordinates are *plan metres*: x east, y south, from the upper left corner of the image. Everything follows from
the seed; the looks of the place (world_paint) draw this one plan in different seasons."""

import itertools
import math
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix_tools.sim.world_places import farms, orchard, row_of_trees, scattered, village, wood
from terrafix_tools.sim.world_shapes import House, Line, Parcel, Warp, densify, divide, long_axis

FIELD_AREA_M2 = (5_000.0, 32_000.0)  # parcels of a small-scale European farmland
VILLAGE_RADIUS_M = (130.0, 190.0)
WOOD_SHARE = 0.13  # of the parcels outside the villages
TREES_PER_HA = {"crop": 0.5, "meadow": 5.0}  # single trees and bushes
HEDGED = {"road": 0.4, "track": 0.35, "border": 0.45}  # share of the lines with trees or bushes along them
DEM_POST_M = 10.0
DEM_MARGIN_M = 300.0  # the DEM reaches beyond the image, as real ones do
GROUND_AMSL_M = 320.0
RELIEF_M = 34.0  # from the river to the hills
VALLEY_M = 620.0  # half width: slopes of a few per cent, as farmland has them


@dataclass(frozen=True)
class Layout:
    width_m: float
    height_m: float
    parcels: list[Parcel]
    lots: list[Parcel]
    lines: list[Line]
    river_m: np.ndarray  # (N, 3): x, y, width
    houses: list[House]
    trees: np.ndarray  # (N, 5): x, y, crown radius, height (m), kind (0 broadleaf, 1 conifer, 2 fruit, 3 bush)
    dem_amsl_m: np.ndarray  # (h, w) float32, posts every DEM_POST_M from (-DEM_MARGIN_M, -DEM_MARGIN_M)


def plan(rng: np.random.Generator, width_m: float, height_m: float) -> Layout:
    """The layout of one place; consumes ``rng``."""
    warp = Warp(rng)
    box = np.array([[-60, -60], [width_m + 60, -60], [width_m + 60, height_m + 60], [-60, height_m + 60]], dtype=float)
    cuts: list[tuple[int, np.ndarray]] = []
    shapes = list(divide(rng, box, FIELD_AREA_M2, cuts))
    river = _river(rng, width_m, height_m)
    centres = [rng.uniform([0.15, 0.15], [0.85, 0.85]) * (width_m, height_m) for _ in range(3)]
    radii = rng.uniform(*VILLAGE_RADIUS_M, size=3)
    wood_field = _smooth_noise(rng, 40, 60, 3)
    values = [float(wood_field[_index(s.mean(axis=0), width_m, height_m, wood_field.shape)]) for s in shapes]
    wood_limit = float(np.quantile(values, 1.0 - WOOD_SHARE))

    parcels: list[Parcel] = []
    lots: list[Parcel] = []
    lines: list[Line] = []
    houses: list[House] = []
    trees: list[np.ndarray] = []
    for shape, value in zip(shapes, values, strict=True):
        centre = shape.mean(axis=0)
        angle = long_axis(shape) + rng.normal(0.0, 0.03)
        in_village = any(np.hypot(*(centre - c)) < r for c, r in zip(centres, radii, strict=True))
        chance = rng.random()
        kind = "crop" if chance < 0.72 else "meadow" if chance < 0.92 else "orchard"
        kind = "village" if in_village else "wood" if value > wood_limit else kind
        outline = warp(densify(shape))
        parcels.append(Parcel(outline, kind, angle, int(rng.integers(1 << 31))))
        if kind == "village":
            village(rng, shape, warp, lots, lines, houses, trees)
        elif kind == "wood":
            trees.append(wood(rng, outline))
        elif kind == "orchard":
            trees.append(orchard(rng, outline, angle))
        else:
            trees.append(scattered(rng, outline, TREES_PER_HA[kind]))
    for depth, cut in cuts:
        points = warp(densify(cut))
        kind, width = ("road", 7.0) if depth < 2 else ("track", 3.5) if depth < 5 else ("border", rng.uniform(1.5, 4.0))
        lines.append(Line(points, kind, width))
        if rng.random() < HEDGED[kind]:
            trees.append(row_of_trees(rng, points, width))
    farms(rng, lines, houses, lots)
    houses = [h for h in houses if _water_distance(river, h.centre_m) > 15.0]
    tree_array = np.concatenate(trees) if trees else np.zeros((0, 5))
    tree_array = tree_array[_clear(tree_array, lines, river, houses, width_m, height_m)]
    dem = _dem(rng, river, width_m, height_m)
    return Layout(width_m, height_m, parcels, lots, lines, river, houses, tree_array, dem)


def _index(point: np.ndarray, width_m: float, height_m: float, shape: tuple[int, ...]) -> tuple[int, int]:
    row = int(np.clip(point[1] / height_m, 0.0, 0.999) * shape[0])
    return row, int(np.clip(point[0] / width_m, 0.0, 0.999) * shape[1])


def _smooth_noise(rng: np.random.Generator, rows: int, cols: int, sigma: float) -> np.ndarray:
    """(rows, cols), zero mean, unit deviation."""
    field = cv2.GaussianBlur(rng.normal(size=(rows, cols)), (0, 0), sigma)
    return (field - field.mean()) / field.std()


def _river(rng: np.random.Generator, width_m: float, height_m: float) -> np.ndarray:
    """(N, 3) x, y, width: meanders from the west to the east, with one lake on its way."""
    s = np.linspace(-100.0, width_m + 100.0, 240)
    base = height_m * (0.5 + 0.18 * rng.uniform(-1, 1))
    slope = rng.uniform(-0.15, 0.15)
    y = base + slope * (s - width_m / 2)
    for length_m, size_m in ((1400.0, 120.0), (520.0, 45.0), (230.0, 16.0)):
        y = y + size_m * np.sin(2 * math.pi * s / length_m + rng.uniform(0, 2 * math.pi))
    lake = rng.uniform(0.3, 0.7) * width_m
    width = 13.0 + 4.0 * np.sin(s / 90.0) + 105.0 * np.exp(-(((s - lake) / 95.0) ** 2))
    return np.stack([s, y, width], axis=1)


def _water_distance(river: np.ndarray, point: tuple[float, float]) -> float:
    """Metres from the bank; negative in the water."""
    return float((np.hypot(river[:, 0] - point[0], river[:, 1] - point[1]) - river[:, 2] / 2).min())


def _clear(
    trees: np.ndarray, lines: list[Line], river: np.ndarray, houses: list[House], width_m: float, height_m: float
) -> np.ndarray:
    """(N,) bool: trees that stand neither on a road nor in the water nor on a roof."""
    taken = np.zeros((int(height_m) + 1, int(width_m) + 1), np.uint8)  # one cell a metre
    for line in lines:
        if line.kind != "border":
            cv2.polylines(taken, [np.round(line.points_m).astype(np.int32)], False, 1, round(line.width_m) + 3)
    for (x0, y0, w0), (x1, y1, _) in itertools.pairwise(river):
        cv2.line(taken, (round(x0), round(y0)), (round(x1), round(y1)), 1, round(w0) + 6)
    for house in houses:
        centre = (round(house.centre_m[0]), round(house.centre_m[1]))
        cv2.circle(taken, centre, round(house.length_m / 2) + 1, 1, -1)
    x, y = np.round(trees[:, 0]).astype(int), np.round(trees[:, 1]).astype(int)
    inside = (x >= 0) & (y >= 0) & (x < taken.shape[1]) & (y < taken.shape[0])
    inside[inside] = taken[y[inside], x[inside]] == 0
    return inside


def _dem(rng: np.random.Generator, river: np.ndarray, width_m: float, height_m: float) -> np.ndarray:
    """Hills around a river valley, metres AMSL."""
    rows = int((height_m + 2 * DEM_MARGIN_M) / DEM_POST_M) + 1
    cols = int((width_m + 2 * DEM_MARGIN_M) / DEM_POST_M) + 1
    hills = _smooth_noise(rng, rows, cols, 38.0) + 0.25 * _smooth_noise(rng, rows, cols, 14.0)
    dry = np.full((rows, cols), 255, np.uint8)
    points = np.round((river[:, :2] + DEM_MARGIN_M) / DEM_POST_M).astype(np.int32)
    cv2.polylines(dry, [points], False, 0, 2)
    distance_m = cv2.distanceTransform(dry, cv2.DIST_L2, 5) * DEM_POST_M
    valley = 1.0 - np.exp(-((distance_m / VALLEY_M) ** 2))
    height = RELIEF_M * (valley * (0.75 + 0.15 * hills) + 0.08 * hills)
    return (GROUND_AMSL_M + cv2.GaussianBlur(height, (0, 0), 3.0)).astype(np.float32)
