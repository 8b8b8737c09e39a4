"""Vector features of a small map, as WKB geometries."""

import struct
from collections.abc import Iterator

from terrafix_tools.mapping.layers import Feature

LON, LAT = 121.05, 23.49


def line(points: list[tuple[float, float]]) -> bytes:
    return struct.pack("<BII", 1, 2, len(points)) + b"".join(struct.pack("<2d", *p) for p in points)


def polygon(*rings: list[tuple[float, float]]) -> bytes:
    """-> WKB in big endian; the other geometries are little endian, so that both byte orders are read."""
    body = b"".join(struct.pack(">I", len(r)) + b"".join(struct.pack(">2d", *p) for p in r) for r in rings)
    return struct.pack(">BII", 0, 3, len(rings)) + body


def multi_line(*parts: list[tuple[float, float]]) -> bytes:
    return struct.pack("<BII", 1, 5, len(parts)) + b"".join(line(part) for part in parts)


ROAD = [(LON, LAT), (LON + 0.001, LAT), (LON + 0.001, LAT + 0.002)]


SQUARE = [(LON, LAT), (LON + 1e-4, LAT), (LON + 1e-4, LAT + 1e-4), (LON, LAT + 1e-4), (LON, LAT)]


HOLE = [(LON + 2e-5, LAT + 2e-5), (LON + 4e-5, LAT + 2e-5), (LON + 4e-5, LAT + 4e-5), (LON + 2e-5, LAT + 2e-5)]


FAR = [(LON + 1, LAT + 1), (LON + 1.1, LAT + 1)]


def features() -> Iterator[Feature]:
    yield "roads", line(ROAD), {"kind": "primary", "name": "Straße 1", "lanes": "2"}
    yield "buildings", polygon(SQUARE, HOLE), {"kind": "yes"}
    yield "roads", multi_line(FAR, ROAD[:2]), {"kind": "track"}
    yield "roads", line([]), {"kind": "nothing"}
    yield "water", struct.pack("<BI2d", 1, 1, LON, LAT), {"kind": "spring", "name": "A"}
