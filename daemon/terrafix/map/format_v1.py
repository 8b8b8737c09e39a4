"""Packages of format 1, which are still read: one layer, elevation in a private table of deflated float32."""

import hashlib
import sqlite3
import zlib
from typing import Any

import numpy as np

from terrafix.map.format import DEM_TILE_PX, ELEVATION_TABLE, IMAGERY_TABLE, HashRow, Layer, Level

DEM_TABLE = "terrafix_dem"
HASH_TABLE = "terrafix_tile_hash"
TABLES = {"gpkg_tile_matrix", "gpkg_tile_matrix_set", IMAGERY_TABLE, HASH_TABLE}


def hashes(db: sqlite3.Connection) -> list[HashRow]:
    """Zoom -1 was elevation; it becomes zoom 0 of its table."""
    return [
        (ELEVATION_TABLE if zoom < 0 else IMAGERY_TABLE, max(zoom, 0), column, row, sha256)
        for zoom, column, row, sha256 in db.execute(
            f"SELECT zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}"
        )
    ]


def checksum_of(rows: dict[str, str], listed: list[HashRow]) -> str:
    digest = hashlib.sha256()
    for key, value in sorted(rows.items()):
        if key != "checksum":
            digest.update(f"{key}={value}\n".encode())
    as_written = [(-1 if table == ELEVATION_TABLE else zoom, c, r, sha) for table, zoom, c, r, sha in listed]
    for zoom, column, row, tile_hash in sorted(as_written):
        digest.update(f"{zoom}/{column}/{row}:".encode() + tile_hash)
    return digest.hexdigest()


def layer(db: sqlite3.Connection, fields: dict[str, Any], tiles: int) -> Layer:
    """The one layer, from the manifest's fields and the tables of the GeoPackage."""
    x_min, y_max = db.execute(
        "SELECT min_x, max_y FROM gpkg_tile_matrix_set WHERE table_name = ?", (IMAGERY_TABLE,)
    ).fetchone()
    bounds = db.execute(
        "SELECT min_x, min_y, max_x, max_y FROM gpkg_contents WHERE table_name = ?", (IMAGERY_TABLE,)
    ).fetchone()
    levels = db.execute(
        "SELECT zoom_level, pixel_x_size, pixel_y_size, matrix_width, matrix_height FROM gpkg_tile_matrix"
        " WHERE table_name = ? ORDER BY zoom_level",
        (IMAGERY_TABLE,),
    )
    named = {name: fields[name] for name in ("date", "licence", "source", "source_sha256", "gsd_m", "crs")}
    return Layer(
        table=IMAGERY_TABLE,
        **named,
        ce90_m=fields.get("ce90_m"),
        x_min=x_min,
        y_max=y_max,
        bounds=bounds,
        levels=tuple(Level(*row) for row in levels),
        tiles=tiles,
    )


def heights(data: bytes) -> np.ndarray:
    """(256, 256) float32 of an elevation tile, which was stored with the first column and row of its neighbours."""
    side = DEM_TILE_PX + 1
    return np.frombuffer(zlib.decompress(data), dtype="<f4").reshape(side, side)[:DEM_TILE_PX, :DEM_TILE_PX]
