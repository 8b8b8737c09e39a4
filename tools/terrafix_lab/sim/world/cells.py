"""Plan of one cell of the generated country: fields, roads, houses and trees, without pixels.

A cell is a quadrilateral between four corners that it shares with its neighbours; it is a function of (seed, i, j).
Coordinates are *plan metres*: x east, y south. The seasons (world/paint.py) draw the same plan.
"""

import functools
import itertools
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix_lab.sim.world.noise import smooth
from terrafix_lab.sim.world.places import farms, orchard, row_of_trees, scattered, village, wood
from terrafix_lab.sim.world.rivers import from_bank_m, rivers
from terrafix_lab.sim.world.shapes import House, Line, Parcel, PlanWarp, densify, divide, long_axis

CELL_M = 1500.0
MAX_CORNER_OFFSET_M = 0.2 * CELL_M  # largest offset of a corner from the square grid
MAX_WARP_M = 30.0  # more than the largest displacement by the warp
FIELD_AREA_M2 = (5_000.0, 32_000.0)  # parcels of a small-scale European farmland
VILLAGES = (0.15, 0.60, 0.25)  # share of the cells with none, one, two
VILLAGE_RADIUS_M = (120.0, 190.0)
FARMS = 3
WOOD_SIZE_M, WOOD_THRESHOLD = (
    170.0,
    1.13,
)  # size (1-sigma) of the forests; threshold of the forest field, in standard deviations
TREES_PER_HA = {"crop": 0.5, "meadow": 5.0}  # single trees and bushes
HEDGED = {"road": 0.4, "track": 0.35, "border": 0.45}  # share of the lines with trees or bushes along them
EDGE_ROADS = 0.6  # share of the cell edges that are roads; the others are tracks
CACHED_CELLS = 40  # a few MB each: what a flight covers, with a margin


@dataclass(frozen=True)
class Cell:
    parcels: list[Parcel]
    lots: list[Parcel]
    lines: list[Line]
    houses: list[House]
    trees: np.ndarray  # (N, 6): x, y, crown radius, height (m), kind (0 broadleaf, 1 conifer, 2 fruit, 3 bush), chance


def cells_around(x0_m: float, y0_m: float, x1_m: float, y1_m: float) -> list[tuple[int, int]]:
    """Indices of the cells that may overlap a box."""
    reach = MAX_CORNER_OFFSET_M + MAX_WARP_M
    columns = range(int((x0_m - reach) // CELL_M), int((x1_m + reach) // CELL_M) + 1)
    rows = range(int((y0_m - reach) // CELL_M), int((y1_m + reach) // CELL_M) + 1)
    return [(i, j) for j in rows for i in columns]


@functools.lru_cache(maxsize=CACHED_CELLS)
def cell(seed: int, i: int, j: int) -> Cell:
    """Returns the plan of cell (i, j); it shares corners and edges with its neighbours."""
    rng = np.random.default_rng([seed, 4, i % 2**32, j % 2**32])
    warp = PlanWarp(np.random.default_rng([seed, 0]))
    corners = [_corner(seed, i + a, j + b) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    cuts: list[tuple[int, np.ndarray]] = []
    shapes = list(divide(rng, np.array(corners), FIELD_AREA_M2, cuts))
    centre_m, reach = np.mean(corners, axis=0), 0.2 * CELL_M
    centres = [centre_m + rng.uniform(-reach, reach, 2) for _ in range(int(rng.choice(3, p=VILLAGES)))]
    radii = rng.uniform(*VILLAGE_RADIUS_M, size=len(centres))

    parcels: list[Parcel] = []
    lots: list[Parcel] = []
    lines: list[Line] = []
    houses: list[House] = []
    trees: list[np.ndarray] = []
    for shape in shapes:
        centre = shape.mean(axis=0)
        angle = long_axis(shape) + rng.normal(0.0, 0.03)
        chance = rng.random()
        kind = "crop" if chance < 0.72 else "meadow" if chance < 0.92 else "orchard"
        kind = "wood" if _forest(seed, centre) > WOOD_THRESHOLD else kind
        if any(np.hypot(*(centre - c)) < r for c, r in zip(centres, radii, strict=True)):
            kind = "village"
        outline = warp(densify(shape))
        parcels.append(Parcel(outline, kind, angle, _key(rng)))
        if kind == "village":
            village(rng, shape, warp, lots, lines, houses, trees)
        elif kind == "wood":
            trees.append(wood(rng, outline))
        elif kind == "orchard":
            trees.append(orchard(rng, outline, angle))
        else:
            trees.append(scattered(rng, outline, TREES_PER_HA[kind]))
    roads = [_road(rng, warp, cut, depth) for depth, cut in cuts]
    edges = [_edge(seed, warp, n, i, j) for n in (0, 1)]
    for line in roads + edges:
        lines.append(line)
        if rng.random() < HEDGED[line.kind]:
            trees.append(row_of_trees(rng, line.points_m, line.width_m))
    farms(rng, lines, houses, lots, FARMS)
    box = np.concatenate([p.outline_m for p in parcels])
    low, high = box.min(axis=0) - 10.0, box.max(axis=0) + 10.0
    water = rivers(seed, *low, *high)
    houses = [h for h in houses if all(from_bank_m(r, h.centre_m) > 15.0 for r in water)]
    others = [_edge(seed, warp, 0, i, j + 1), _edge(seed, warp, 1, i + 1, j)]
    found = np.concatenate(trees) if trees else np.zeros((0, 6))
    found = found[_unobstructed(found, lines + others, water, houses, low, high)]
    return Cell(parcels, lots, lines, houses, found)


def _key(rng: np.random.Generator) -> int:
    return int(rng.integers(1 << 31))


def _corner(seed: int, i: int, j: int) -> np.ndarray:
    rng = np.random.default_rng([seed, 5, i % 2**32, j % 2**32])
    return np.array([i, j]) * CELL_M + rng.uniform(-MAX_CORNER_OFFSET_M, MAX_CORNER_OFFSET_M, 2)


def _edge(seed: int, warp: PlanWarp, side: int, i: int, j: int) -> Line:
    """The upper (0) or left (1) edge of a cell, which belongs to that cell."""
    rng = np.random.default_rng([seed, 6, side, i % 2**32, j % 2**32])
    ends = np.array([_corner(seed, i, j), _corner(seed, i + 1 - side, j + side)])
    kind, width = ("road", 7.0) if rng.random() < EDGE_ROADS else ("track", 3.5)
    return Line(warp(densify(ends)), kind, width, _key(rng))


def _road(rng: np.random.Generator, warp: PlanWarp, cut: np.ndarray, depth: int) -> Line:
    kind, width = ("road", 7.0) if depth < 1 else ("track", 3.5) if depth < 4 else ("border", rng.uniform(1.5, 4.0))
    return Line(warp(densify(cut)), kind, width, _key(rng))


def _forest(seed: int, point: np.ndarray) -> float:
    """Forest field in standard deviations, on a 10 m grid."""
    return float(smooth(seed + 211, WOOD_SIZE_M / 10.0, int(point[0] // 10), int(point[1] // 10), 1, 1)[0, 0])


def _unobstructed(
    trees: np.ndarray,
    lines: list[Line],
    water: list[np.ndarray],
    houses: list[House],
    low: np.ndarray,
    high: np.ndarray,
) -> np.ndarray:
    """(N,) bool: True for trees that are not on a road, in water or on a roof."""
    corner = np.floor(low)
    columns, rows = (np.ceil(high - corner)).astype(int) + 1
    occupied = np.zeros((rows, columns), np.uint8)  # one pixel a metre
    for line in lines:
        if line.kind != "border":
            points = np.round(line.points_m - corner).astype(np.int32)
            cv2.polylines(occupied, [points], False, 1, round(line.width_m) + 3)
    for river in water:
        bed = np.column_stack([np.round(river[:, :2] - corner), np.round(river[:, 2])]).astype(int).tolist()
        for (x0, y0, w0), (x1, y1, _) in itertools.pairwise(bed):
            cv2.line(occupied, (x0, y0), (x1, y1), 1, w0 + 6)
    for house in houses:
        centre = (round(house.centre_m[0] - corner[0]), round(house.centre_m[1] - corner[1]))
        cv2.circle(occupied, centre, round(house.length_m / 2) + 1, 1, -1)
    x, y = np.round(trees[:, :2] - corner).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < columns) & (y < rows)
    inside[inside] = occupied[y[inside], x[inside]] == 0
    return inside
