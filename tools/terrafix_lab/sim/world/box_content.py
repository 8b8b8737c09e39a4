"""The content of the country's cells inside a box, for one canvas."""

from dataclasses import dataclass, replace

import numpy as np

from terrafix_lab.sim.world.cells import cell, cells_around
from terrafix_lab.sim.world.rivers import rivers
from terrafix_lab.sim.world.shapes import House, Line, Parcel


@dataclass(frozen=True)
class Piece:
    """Metres are relative to the box's upper left corner. Lines are in drawing order: narrow ones first."""

    parcels: list[Parcel]
    lots: list[Parcel]
    lines: list[Line]
    houses: list[House]
    trees: np.ndarray  # (N, 6), as Cell.trees
    rivers: list[np.ndarray]  # (N, 3): x, y, width


def piece_of(seed: int, x0_m: float, y0_m: float, width_m: float, height_m: float) -> Piece:
    """Collects everything that touches a box of plan metres."""
    corner, far = np.array([x0_m, y0_m]), np.array([x0_m + width_m, y0_m + height_m])
    cells = [cell(seed, i, j) for i, j in cells_around(*corner, *far)]

    def touches(points_m: np.ndarray, reach_m: float = 0.0) -> bool:
        return bool((points_m.max(axis=0) + reach_m > corner).all() and (points_m.min(axis=0) - reach_m < far).all())

    def moved(parcels: list[Parcel]) -> list[Parcel]:
        return [replace(p, outline_m=p.outline_m - corner) for p in parcels if touches(p.outline_m)]

    lines = [one for c in cells for one in c.lines if touches(one.points_m, one.width_m + 3.0)]
    houses = [h for c in cells for h in c.houses if touches(np.array([h.centre_m]), h.length_m)]
    trees = np.concatenate([c.trees for c in cells])
    inside = ((trees[:, :2] > corner) & (trees[:, :2] < far)).all(axis=1)
    return Piece(
        parcels=[p for c in cells for p in moved(c.parcels)],
        lots=[p for c in cells for p in moved(c.lots)],
        lines=[replace(one, points_m=one.points_m - corner) for one in sorted(lines, key=lambda one: one.width_m)],
        houses=[replace(h, centre_m=(h.centre_m[0] - x0_m, h.centre_m[1] - y0_m)) for h in houses],
        trees=trees[inside] - np.array([x0_m, y0_m, 0.0, 0.0, 0.0, 0.0]),
        rivers=[r - np.array([x0_m, y0_m, 0.0]) for r in rivers(seed, *corner, *far)],
    )
