"""Feature tables of a map package: roads, water, buildings, with an R-tree each."""

import json
import re
import sqlite3
import struct

import numpy as np

from terrafix.anchor.map_format import VectorTable
from terrafix.anchor.map_vectors import features_sha256_of, wkb_parts
from terrafix.core.errors import MapError
from terrafix_tools.mapping import gpkg_schema
from terrafix_tools.mapping.gpkg import WGS84, GpkgWriter
from terrafix_tools.mapping.layers import VectorInput

TABLE_NAME = re.compile(r"[a-z][a-z0-9_]{0,30}")
TAKEN = re.compile(r"(imagery|elevation|gpkg|terrafix|rtree|sqlite)")
LITTLE_ENDIAN_XY_ENVELOPE = 0b0000_0011  # flags of a GeoPackage geometry's header


def write_vectors(writer: GpkgWriter, db: sqlite3.Connection, given: VectorInput) -> tuple[VectorTable, ...]:
    """All features, each into its table in the order given. Raises MapError: a geometry or name that cannot be kept."""
    boxes: dict[str, np.ndarray] = {}  # min and max of longitude and latitude
    counts: dict[str, int] = {}
    for table, wkb, attributes in given.features:
        if table not in boxes:
            _check_name(table, given.source)
            if not boxes:
                writer.create(gpkg_schema.GEOMETRY_COLUMNS)
            writer.create(gpkg_schema.FEATURES.format(table=table))
            boxes[table], counts[table] = np.array([[np.inf, np.inf], [-np.inf, -np.inf]]), 0
        try:
            parts = [part for part in wkb_parts(wkb) if len(part)]
        except MapError as error:
            raise MapError(f"{given.source}: {error}") from None
        if not parts:
            continue
        low = np.min([part.min(axis=0) for part in parts], axis=0)
        high = np.max([part.max(axis=0) for part in parts], axis=0)
        boxes[table] = np.array([np.minimum(boxes[table][0], low), np.maximum(boxes[table][1], high)])
        header = struct.pack("<2sBBi4d", b"GP", 0, LITTLE_ENDIAN_XY_ENVELOPE, WGS84, low[0], high[0], low[1], high[1])
        text = json.dumps(dict(attributes), ensure_ascii=False, sort_keys=True)
        fid = db.execute(
            f'INSERT INTO "{table}" (geom, kind, name, attributes) VALUES (?, ?, ?, ?)',
            (header + wkb, attributes.get("kind", ""), attributes.get("name", ""), text),
        ).lastrowid
        db.execute(f'INSERT INTO "rtree_{table}_geom" VALUES (?, ?, ?, ?, ?)', (fid, low[0], high[0], low[1], high[1]))
        counts[table] += 1
    for table, box in boxes.items():
        whole = tuple(float(v) for v in box.ravel()) if counts[table] else None
        writer.add_contents(table, "features", given.date, given.licence, whole, WGS84)  # type: ignore[arg-type]
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
