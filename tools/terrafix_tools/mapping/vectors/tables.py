"""Feature tables of a map package: roads, water, buildings, with an R-tree each."""

import json
import math
import re
import sqlite3
import struct

import numpy as np

from terrafix.core.errors import MapError
from terrafix.map.format import VectorTable
from terrafix.map.vectors import features_sha256_of, wkb_parts
from terrafix_tools.mapping.imagery import Bounds
from terrafix_tools.mapping.layers import VectorInput
from terrafix_tools.mapping.package import gpkg_schema
from terrafix_tools.mapping.package.gpkg import WGS84, GpkgWriter

TABLE_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
TAKEN = re.compile(r"(imagery|drawn|elevation|gpkg|terrafix|rtree|sqlite)")
LITTLE_ENDIAN_XY_ENVELOPE = 0b0000_0011  # flags in the header of a GeoPackage geometry


def write_vectors(writer: GpkgWriter, db: sqlite3.Connection, given: VectorInput) -> tuple[VectorTable, ...]:
    """Writes features into their tables in the given order. Raises MapError: an invalid geometry or name."""
    boxes: dict[str, Bounds] = {}
    counts: dict[str, int] = {}
    for table, wkb, attributes in given.features:
        if table not in boxes:
            _check_name(table, given.source)
            writer.create(gpkg_schema.FEATURES.format(table=table))
            boxes[table], counts[table] = (math.inf, math.inf, -math.inf, -math.inf), 0
        try:
            parts = [part for part in wkb_parts(wkb) if len(part)]
        except MapError as error:
            raise MapError(f"{given.source}: {error}") from None
        if not parts:
            continue
        points = parts[0] if len(parts) == 1 else np.concatenate(parts)
        (west, south), (east, north) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
        box = boxes[table]
        boxes[table] = min(box[0], west), min(box[1], south), max(box[2], east), max(box[3], north)
        header = struct.pack("<2sBBi4d", b"GP", 0, LITTLE_ENDIAN_XY_ENVELOPE, WGS84, west, east, south, north)
        text = json.dumps(dict(attributes), ensure_ascii=False, sort_keys=True)
        fid = db.execute(
            f'INSERT INTO "{table}" (geom, kind, name, attributes) VALUES (?, ?, ?, ?)',
            (header + wkb, attributes.get("kind", ""), attributes.get("name", ""), text),
        ).lastrowid
        db.execute(f'INSERT INTO "rtree_{table}_geom" VALUES (?, ?, ?, ?, ?)', (fid, west, east, south, north))
        counts[table] += 1
    for table, box in boxes.items():
        writer.add_contents(table, "features", given.date, given.licence, box if counts[table] else None, WGS84)
        row = (table, "geom", "GEOMETRY", WGS84, 0, 0)
        db.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", row)
        writer.create(gpkg_schema.RTREE_TRIGGERS.format(table=table))
        writer.add_extension(table, "geom", "gpkg_rtree_index")
        writer.add_metadata(table, table, given.date, given.licence, given.source)
    return tuple(
        VectorTable(
            table=table,
            features=counts[table],
            sha256=features_sha256_of(db, table),
            source=given.source,
            date=given.date,
            licence=given.licence,
        )
        for table in boxes
    )


def _check_name(table: str, source: str) -> None:
    if not TABLE_NAME.fullmatch(table) or TAKEN.match(table):
        raise MapError(f"{source}: '{table}' cannot be the name of a table of features; use roads, water or buildings")
