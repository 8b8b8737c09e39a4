"""Roads, water and buildings of OpenStreetMap: table by tags, and geometries as WKB (OGC 06-103r4)."""

import struct
from collections.abc import Mapping, Sequence

import numpy as np

from terrafix_tools.mapping.vectors.rings import Ring

LICENCE = "(c) OpenStreetMap contributors, ODbL 1.0"
TABLES = {"roads": ("highway", "railway"), "water": ("waterway", "natural", "landuse"), "buildings": ("building",)}
WATER = {"natural": {"water", "bay"}, "landuse": {"reservoir", "basin"}}
NOT_VISIBLE = {"proposed", "planned", "razed", "abandoned", "no", "subway"}  # not visible from above
KEPT = ("name", "surface", "width", "intermittent", "bridge", "tunnel", "lanes")
LINE, POLYGON = 2, 3  # WKB geometry types


def table_of(tags: Mapping[str, str]) -> tuple[str, dict[str, str]] | None:
    """Table and attributes of an object with these tags; None: not used."""
    for table, keys in TABLES.items():
        for key in keys:
            value = tags.get(key, "")
            if not value or value in NOT_VISIBLE or value not in WATER.get(key, {value}):
                continue
            if table != "buildings" and tags.get("tunnel") in ("yes", "culvert"):
                return None
            attributes = {"kind": value if table != "water" or key == "waterway" else "water"}
            return table, attributes | {k: tags[k] for k in KEPT if k in tags}
    return None


def is_surface(table: str, tags: Mapping[str, str]) -> bool:
    """True when a closed line with these tags is the outline of a surface."""
    return table == "buildings" or (table == "water" and tags.get("waterway") in (None, "riverbank", "dock"))


def line_wkb(points: Ring) -> bytes:
    return struct.pack("<BII", 1, LINE, len(points)) + _packed(points)


def polygon_wkb(rings: Sequence[Ring]) -> bytes:
    """WKB of a polygon: the outer ring first; rings are closed."""
    body = b"".join(struct.pack("<I", len(ring)) + _packed(ring) for ring in rings)
    return struct.pack("<BII", 1, POLYGON, len(rings)) + body


def _packed(points: Ring) -> bytes:
    return np.asarray(points, "<f8").tobytes()
