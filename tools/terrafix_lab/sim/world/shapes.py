"""Shapes of a generated place: parcels, lines, houses, and their subdivision and warping."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

WARP_M = 9.0  # amplitude: natural boundaries are not straight


@dataclass(frozen=True)
class Parcel:
    outline_m: np.ndarray  # (N, 2)
    kind: str  # "crop", "meadow", "wood", "orchard", "village"
    row_angle_rad: float  # direction of the crop rows
    key: int  # seed of the season's variation of this parcel


@dataclass(frozen=True)
class Line:
    points_m: np.ndarray  # (N, 2)
    kind: str  # "road", "street", "track", "border"
    width_m: float
    key: int  # seed of its traffic


@dataclass(frozen=True)
class House:
    centre_m: tuple[float, float]
    length_m: float
    width_m: float
    angle_rad: float
    height_m: float
    roof: int  # colour index
    key: int  # seed of the season's variation of this house
    absent: tuple[str, ...] = ()  # seasons in which it does not exist: built or demolished in between


class PlanWarp:
    """Warps straight plans slightly: plan metres (N, 2) -> plan metres (N, 2)."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._waves = [(rng.uniform(350.0, 900.0), rng.uniform(0.0, 2 * math.pi, 2)) for _ in range(3)]

    def __call__(self, points: np.ndarray) -> np.ndarray:
        out = points.copy()
        for length_m, phase in self._waves:
            out[:, 0] += WARP_M * np.sin(2 * math.pi * points[:, 1] / length_m + phase[0])
            out[:, 1] += WARP_M * np.sin(2 * math.pi * points[:, 0] / length_m + phase[1])
        return out


def densify(points: np.ndarray, step_m: float = 25.0) -> np.ndarray:
    """Adds points along the edges; a polygon is closed, a line of two points is not."""
    ends = np.roll(points, -1, axis=0) if len(points) > 2 else points[1:]
    pieces = []
    for start, end in zip(points, ends, strict=False):
        count = max(1, int(np.hypot(*(end - start)) // step_m))
        pieces.append(start + (end - start) * np.linspace(0.0, 1.0, count, endpoint=False)[:, None])
    if len(points) == 2:
        pieces.append(points[-1:])
    return np.concatenate(pieces)


def _area(poly: np.ndarray) -> float:
    x, y = poly.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))))


def long_axis(poly: np.ndarray) -> float:
    (_, _), (w, h), angle_deg = cv2.minAreaRect(poly.astype(np.float32))
    return math.radians(angle_deg if w >= h else angle_deg + 90.0)


def divide(
    rng: np.random.Generator,
    poly: np.ndarray,
    area_m2: tuple[float, float],
    cuts: list[tuple[int, np.ndarray]],
    depth: int = 0,
) -> Iterator[np.ndarray]:
    """Cuts a convex polygon across its long axis until the parts are as small as a random value from ``area_m2``."""
    if _area(poly) < rng.uniform(*area_m2) * 1.5:
        yield poly
        return
    axis = long_axis(poly) + rng.normal(0.0, 0.10)
    direction = np.array([math.cos(axis), math.sin(axis)])
    along = poly @ direction
    where = along.min() + (along.max() - along.min()) * rng.uniform(0.38, 0.62)
    first, second, cut = _cut(poly, along - where)
    if len(cut) == 2:
        cuts.append((depth, cut))
    for piece in (first, second):
        yield from divide(rng, piece, area_m2, cuts, depth + 1)


def _cut(poly: np.ndarray, side: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Splits a convex polygon by the signed distances of its corners; returns the negative part, the positive part and
    the cut (2, 2).
    """
    parts: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    crossing: list[np.ndarray] = []
    for i in range(len(poly)):
        j = (i + 1) % len(poly)
        parts[int(side[i] > 0)].append(poly[i])
        if (side[i] > 0) != (side[j] > 0):
            point = poly[i] + (poly[j] - poly[i]) * side[i] / (side[i] - side[j])
            parts[0].append(point)
            parts[1].append(point)
            crossing.append(point)
    return np.array(parts[0]), np.array(parts[1]), np.array(crossing)
