"""Reader for packages of format 1: one layer, elevation in a private table of zlib-compressed float32 tiles."""

import hashlib
import sqlite3
import zlib
from typing import Any

import numpy as np

from terrafix.map.format import DEM_TILE_PX, ELEVATION_TABLE, IMAGERY_TABLE, HashRow, Layer, Level
from terrafix.map.rows import typed_rows

DEM_TABLE = "terrafix_dem"
HASH_TABLE = "terrafix_tile_hash"
TABLES = {"gpkg_tile_matrix", "gpkg_tile_matrix_set", IMAGERY_TABLE, HASH_TABLE}


def hashes(db: sqlite3.Connection) -> list[HashRow]:
    """Tile hashes. Format 1 marks elevation with zoom -1; it is mapped to zoom 0 of the elevation table."""
    return [
        (ELEVATION_TABLE if zoom < 0 else IMAGERY_TABLE, max(zoom, 0), column, row, sha256)
        for zoom, column, row, sha256 in typed_rows(
            db, f"SELECT zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}", tuple[int, int, int, bytes]
        )
    ]


def checksum_of(rows: dict[str, str], listed: list[HashRow]) -> str:
    """Checksum as format 1 defines it: without table names, elevation as zoom -1."""
    digest = hashlib.sha256()
    for key, value in sorted(rows.items()):
        if key != "checksum":
            digest.update(f"{key}={value}\n".encode())
    entries = [(-1 if table == ELEVATION_TABLE else zoom, c, r, sha) for table, zoom, c, r, sha in listed]
    for zoom, column, row, tile_hash in sorted(entries):
        digest.update(f"{zoom}/{column}/{row}:".encode() + tile_hash)
    return digest.hexdigest()


def layer(db: sqlite3.Connection, fields: dict[str, Any], tiles: int) -> Layer:
    """The single layer, from the manifest fields and the GeoPackage tables."""
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
    copied = {name: fields[name] for name in ("date", "licence", "source", "source_sha256", "gsd_m", "crs")}
    return Layer(
        table=IMAGERY_TABLE,
        **copied,
        ce90_m=fields.get("ce90_m"),
        x_min=x_min,
        y_max=y_max,
        bounds=bounds,
        levels=tuple(Level(*row) for row in levels),
        tiles=tiles,
    )


def heights(data: bytes) -> np.ndarray:
    """Decodes an elevation tile to (256, 256) float32. It is stored with the first column and row of its neighbours."""
    side = DEM_TILE_PX + 1
    return np.frombuffer(zlib.decompress(data), dtype="<f4").reshape(side, side)[:DEM_TILE_PX, :DEM_TILE_PX]
