"""Multipolygon relations of OpenStreetMap (wiki.openstreetmap.org, Relation:multipolygon): assembly of closed rings."""

from collections.abc import Sequence

import numpy as np

Point = tuple[float, float]  # lon, lat
Ring = Sequence[Point]


def rings_of(ways: Sequence[Ring]) -> list[list[Point]]:
    """Closed rings of one or more ways with common end points; open chains are dropped."""
    closed: list[list[Point]] = []
    open_: list[list[Point]] = []
    for way in ways:
        points = list(way)
        if len(points) >= 4 and points[0] == points[-1]:
            closed.append(points)
        elif len(points) >= 2:
            open_.append(points)
    while open_:
        ring = open_.pop()
        while ring[0] != ring[-1]:
            follower = next((i for i, way in enumerate(open_) if ring[-1] in (way[0], way[-1])), None)
            if follower is None:
                break
            way = open_.pop(follower)
            ring += way[1:] if way[0] == ring[-1] else way[-2::-1]
        if len(ring) >= 4 and ring[0] == ring[-1]:
            closed.append(ring)
    return closed


def polygons_of(outer: Sequence[Ring], inner: Sequence[Ring]) -> list[list[list[Point]]]:
    """Polygons as lists of rings, the outer one first; a hole belongs to the first outer ring that contains it."""
    polygons = [[ring] for ring in rings_of(outer)]
    for hole in rings_of(inner):
        for polygon in polygons:
            if contains(polygon[0], hole[0]):
                polygon.append(hole)
                break
    return polygons


def contains(ring: Ring, point: Point) -> bool:
    """Point in polygon by the even-odd rule."""
    x, y = np.asarray(ring, float).T
    x1, y1, x2, y2 = x[:-1], y[:-1], x[1:], y[1:]
    crosses = (y1 > point[1]) != (y2 > point[1])
    with np.errstate(divide="ignore", invalid="ignore"):
        at = x1 + (point[1] - y1) / (y2 - y1) * (x2 - x1)
    return bool(np.count_nonzero(crosses & (point[0] < at)) % 2)
