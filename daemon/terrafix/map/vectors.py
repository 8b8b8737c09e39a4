"""Roads, water and buildings of a package: features of a box, from GeoPackage geometry (OGC 12-128r18, 2.1.3)."""

import json
import sqlite3
import struct
from dataclasses import dataclass

import numpy as np

from terrafix.core.errors import MapError
from terrafix.map.format import VectorTable, features_sha256

ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # of the envelope kinds in the flags of a geometry's header
DEEPEST = 4  # nesting of collections: a collection of multipolygons needs three
POINT, LINE, POLYGON, COLLECTIONS = 1, 2, 3, (4, 5, 6, 7)  # WKB types, OGC 06-103r4 8.2.3


@dataclass(frozen=True)
class Feature:
    """``parts``: (N, 2) float64 longitude and latitude, degrees: points, lines, or the rings of polygons."""

    kind: str  # the value of the OpenStreetMap key, for example "primary" or "river"
    name: str
    attributes: dict[str, str]
    parts: tuple[np.ndarray, ...]


def features_sha256_of(db: sqlite3.Connection, table: str) -> str:
    columns = "fid, CAST(geom AS BLOB), CAST(kind AS TEXT), CAST(name AS TEXT), CAST(attributes AS TEXT)"
    return features_sha256(db.execute(f'SELECT {columns} FROM "{table}" ORDER BY fid'))


def read_features(
    db: sqlite3.Connection, vectors: VectorTable, west: float, south: float, east: float, north: float
) -> list[Feature]:
    """Features of one table that may touch a box in degrees, by the R-tree. Raises MapError: not what was written."""
    table = vectors.table
    found = db.execute(
        f'SELECT kind, name, attributes, geom FROM "{table}" WHERE fid IN (SELECT id FROM "rtree_{table}_geom"'
        " WHERE maxx >= ? AND minx <= ? AND maxy >= ? AND miny <= ?) ORDER BY fid",
        (west, east, south, north),
    )
    return [Feature(kind, name, json.loads(text), parts_of(geometry)) for kind, name, text, geometry in found]


def parts_of(geometry: bytes) -> tuple[np.ndarray, ...]:
    """Parts of a GeoPackage geometry: its header, then WKB. Raises MapError."""
    if geometry[:2] != b"GP" or len(geometry) < 8:
        raise MapError("a feature of the map has no GeoPackage geometry; build the package again")
    kind = (geometry[3] >> 1) & 7
    if kind >= len(ENVELOPE_BYTES):
        raise MapError("a feature of the map has an unknown kind of envelope; build the package again")
    return wkb_parts(geometry[8 + ENVELOPE_BYTES[kind] :])


def wkb_parts(wkb: bytes) -> tuple[np.ndarray, ...]:
    """(N, 2) arrays of a 2D geometry in WKB. Raises MapError: malformed, or a type with z or m."""
    parts: list[np.ndarray] = []
    try:
        end = _read(wkb, 0, parts, 1)
    except (struct.error, ValueError, IndexError):
        end = -1
    if end != len(wkb):
        raise MapError("a feature has a geometry that is not two-dimensional WKB")
    return tuple(parts)


def _read(wkb: bytes, at: int, parts: list[np.ndarray], depth: int) -> int:
    """Appends the parts of the geometry at an offset; returns where it ends."""
    order = "<" if wkb[at] == 1 else ">"
    (kind,) = struct.unpack_from(order + "I", wkb, at + 1)
    at += 5
    if kind == POINT:
        return _points(wkb, at, 1, order, parts)
    (count,) = struct.unpack_from(order + "I", wkb, at)
    at += 4
    if kind == LINE:
        return _points(wkb, at, count, order, parts)
    for _ in range(count):
        if kind == POLYGON:
            (size,) = struct.unpack_from(order + "I", wkb, at)
            at = _points(wkb, at + 4, size, order, parts)
        elif kind in COLLECTIONS and depth < DEEPEST:
            at = _read(wkb, at, parts, depth + 1)
        else:
            raise ValueError(kind)
    return at


def _points(wkb: bytes, at: int, count: int, order: str, parts: list[np.ndarray]) -> int:
    flat = np.frombuffer(wkb, order + "f8", 2 * count, at)
    if not np.isfinite(flat).all():
        raise ValueError("not a number")
    parts.append(flat.reshape(-1, 2).astype(np.float64))
    return at + 16 * count
