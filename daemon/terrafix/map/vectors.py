"""Vector features of a map package (roads, water, buildings): box query, GeoPackage geometry (OGC 12-128r18, 2.1.3)."""

import json
import sqlite3
import struct
from dataclasses import dataclass

import numpy as np

from terrafix.core.errors import MapError
from terrafix.map.format import VectorTable, features_sha256

ENVELOPE_BYTES = (0, 32, 48, 48, 64)  # envelope size by the envelope code in the flags of the geometry header
MAX_NESTING = 4  # maximum nesting of collections; a collection of multipolygons needs three
POINT, LINE, POLYGON, COLLECTIONS = 1, 2, 3, (4, 5, 6, 7)  # WKB types, OGC 06-103r4 8.2.3


@dataclass(frozen=True)
class Feature:
    """``parts``: (N, 2) float64 longitude, latitude in degrees: points, lines, or rings of polygons."""

    kind: str  # value of the OpenStreetMap key, for example "primary" or "river"
    name: str
    attributes: dict[str, str]
    parts: tuple[np.ndarray, ...]


def features_sha256_of(db: sqlite3.Connection, table: str) -> str:
    """Hash over all rows of a feature table (``format.features_sha256``)."""
    columns = "fid, CAST(geom AS BLOB), CAST(kind AS TEXT), CAST(name AS TEXT), CAST(attributes AS TEXT)"
    return features_sha256(db.execute(f'SELECT {columns} FROM "{table}" ORDER BY fid'))


def read_features(
    db: sqlite3.Connection, vectors: VectorTable, west: float, south: float, east: float, north: float
) -> list[Feature]:
    """Features of one table whose bounding box intersects a box in degrees (R-tree query). Raises MapError: bad row."""
    table = vectors.table
    found = db.execute(
        f'SELECT kind, name, attributes, geom FROM "{table}" WHERE fid IN (SELECT id FROM "rtree_{table}_geom"'
        " WHERE maxx >= ? AND minx <= ? AND maxy >= ? AND miny <= ?) ORDER BY fid",
        (west, east, south, north),
    )
    return [Feature(kind, name, json.loads(text), geometry_parts(geometry)) for kind, name, text, geometry in found]


def geometry_parts(geometry: bytes) -> tuple[np.ndarray, ...]:
    """Parts (N, 2) of a GeoPackage geometry: GeoPackage header, then WKB. Raises MapError."""
    if geometry[:2] != b"GP" or len(geometry) < 8:
        raise MapError("a feature of the map has no GeoPackage geometry; build the package again")
    kind = (geometry[3] >> 1) & 7
    if kind >= len(ENVELOPE_BYTES):
        raise MapError("a feature of the map has an unknown kind of envelope; build the package again")
    return wkb_parts(geometry[8 + ENVELOPE_BYTES[kind] :])


def wkb_parts(wkb: bytes) -> tuple[np.ndarray, ...]:
    """2D geometry in WKB -> (N, 2) arrays. Raises MapError: malformed WKB, or a geometry type with Z or M."""
    parts: list[np.ndarray] = []
    try:
        end = _read_geometry(wkb, 0, parts, 1)
    except (struct.error, ValueError, IndexError):
        end = -1
    if end != len(wkb):
        raise MapError("a feature has a geometry that is not two-dimensional WKB")
    return tuple(parts)


def _read_geometry(wkb: bytes, at: int, parts: list[np.ndarray], depth: int) -> int:
    """Appends the parts of the geometry at offset ``at``; returns the offset of its end."""
    order = "<" if wkb[at] == 1 else ">"
    (kind,) = struct.unpack_from(order + "I", wkb, at + 1)
    at += 5
    if kind == POINT:
        return _read_points(wkb, at, 1, order, parts)
    (count,) = struct.unpack_from(order + "I", wkb, at)
    at += 4
    if kind == LINE:
        return _read_points(wkb, at, count, order, parts)
    for _ in range(count):
        if kind == POLYGON:
            (size,) = struct.unpack_from(order + "I", wkb, at)
            at = _read_points(wkb, at + 4, size, order, parts)
        elif kind in COLLECTIONS and depth < MAX_NESTING:
            at = _read_geometry(wkb, at, parts, depth + 1)
        else:
            raise ValueError(kind)
    return at


def _read_points(wkb: bytes, at: int, count: int, order: str, parts: list[np.ndarray]) -> int:
    flat = np.frombuffer(wkb, order + "f8", 2 * count, at)
    if not np.isfinite(flat).all():
        raise ValueError("not a number")
    parts.append(flat.reshape(-1, 2).astype(np.float64))
    return at + 16 * count
