"""Tiles of an open map package: fetched, checked against their sha256, decoded and kept in a bounded cache."""

import sqlite3
from collections import OrderedDict
from collections.abc import Iterator

import cv2
import numpy as np

from terrafix.map import format_v1
from terrafix.map.format import (
    DEM_NULL,
    DEM_TILE_PX,
    ELEVATION_TABLE,
    HASH_TABLE,
    TILE_PX,
    HashRow,
    Level,
    tile_sha256,
)

CACHE_BYTES = 100_000_000  # decoded tiles; about 500, a window of 1 km at 0.5 m/px needs 80, at 0.24 m/px 320
VOID_BYTES = 100  # what a void costs in the cache, so that a walk through nothing is bounded too

Key = tuple[str, int, int, int]  # table, zoom, column, row
Tile = tuple[np.ndarray, bool]  # pixels; whether all of them are valid
Part = tuple[slice, slice]  # rows and columns


class TileStore:
    """Decoded tiles. A tile that is damaged is void and listed in ``damaged``."""

    def __init__(self, db: sqlite3.Connection, format_version: int) -> None:
        self._db = db
        self._first_format = format_version == 1
        self.damaged: set[Key] = set()
        self._cache: OrderedDict[Key, Tile | None] = OrderedDict()
        self._cached_bytes = 0

    def tile(self, key: Key) -> Tile | None:
        """(256, 256, 3) uint8 BGR and True when all is valid, else (256, 256, 4) with a mask of 0 and 255 and False.
        None: nothing there.

        Of the elevation table: (256, 256) float32 metres AMSL, NaN = void; of a table of descriptors: (height, width)
        uint8 as stored (``map_format.DescriptorTable``)."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        tile = self._decode(key)
        self._cache[key] = tile
        self._cached_bytes += _size(tile)
        while self._cached_bytes > CACHE_BYTES:
            self._cached_bytes -= _size(self._cache.popitem(last=False)[1])
        return tile

    def mosaic(self, table: str, level: Level, u_0: int, v_0: int, width: int, height: int) -> Tile:
        """Pixels [v_0, v_0 + height) x [u_0, u_0 + width) of a level: (height, width, 4), and whether all are valid."""
        image = np.empty((height, width, 4), np.uint8)
        whole = True
        for row in range(v_0 // TILE_PX, (v_0 + height - 1) // TILE_PX + 1):
            top = row * TILE_PX - v_0
            rows = slice(max(top, 0), min(top + TILE_PX, height))
            for column in range(u_0 // TILE_PX, (u_0 + width - 1) // TILE_PX + 1):
                left = column * TILE_PX - u_0
                columns = slice(max(left, 0), min(left + TILE_PX, width))
                inside = 0 <= column < level.columns and 0 <= row < level.rows
                tile = self.tile((table, level.zoom, column, row)) if inside else None
                if tile is None:
                    image[rows, columns] = 0
                    whole = False
                else:
                    across = slice(columns.start - left, columns.stop - left)
                    put_picture(tile, (slice(rows.start - top, rows.stop - top), across), image[rows, columns])
                    whole &= tile[1]
        return image, whole

    def hashes(self) -> Iterator[HashRow]:
        """What is recorded of every tile, in order."""
        if self._first_format:
            yield from sorted(format_v1.hashes(self._db))
            return
        yield from self._db.execute(f"SELECT table_name, zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}")

    def is_whole(self, key: Key, sha256: bytes) -> bool:
        """Whether the tile is there and is what was written."""
        found = self._stored(key)
        return found is not None and tile_sha256(*found) == sha256

    def clear(self) -> None:
        self._cache.clear()
        self._cached_bytes = 0

    def _stored(self, key: Key) -> tuple[bytes, float | None, float | None] | None:
        """Bytes as stored; with scale and offset for elevation."""
        table, zoom, column, row = key
        if table != ELEVATION_TABLE:
            found = self._db.execute(
                f'SELECT CAST(tile_data AS BLOB) FROM "{table}"'
                " WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, column, row),
            ).fetchone()
        elif self._first_format:
            found = self._db.execute(
                f"SELECT CAST(tile_data AS BLOB) FROM {format_v1.DEM_TABLE} WHERE tile_column = ? AND tile_row = ?",
                (column, row),
            ).fetchone()
        else:
            found = self._db.execute(
                f"SELECT CAST(tile_data AS BLOB), scale, offset FROM {ELEVATION_TABLE}"
                " JOIN gpkg_2d_gridded_tile_ancillary"
                f" ON tpudt_name = '{ELEVATION_TABLE}' AND tpudt_id = {ELEVATION_TABLE}.id"
                " WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, column, row),
            ).fetchone()
            return None if found is None else (found[0], float(found[1]), float(found[2]))
        return None if found is None else (found[0], None, None)

    def _recorded(self, key: Key) -> bytes | None:
        if self._first_format:
            where = (-1 if key[0] == ELEVATION_TABLE else key[1], key[2], key[3])
            found = self._db.execute(
                f"SELECT sha256 FROM {format_v1.HASH_TABLE} WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                where,
            ).fetchone()
        else:
            found = self._db.execute(
                f"SELECT sha256 FROM {HASH_TABLE}"
                " WHERE table_name = ? AND zoom_level = ? AND tile_column = ? AND tile_row = ?",
                key,
            ).fetchone()
        return None if found is None else found[0]

    def _decode(self, key: Key) -> Tile | None:
        try:
            recorded, stored = self._recorded(key), self._stored(key)
        except (sqlite3.DatabaseError, ValueError):  # a bad page on the disk
            self.damaged.add(key)
            return None
        if recorded is None and stored is None:
            return None
        if recorded is None or stored is None or tile_sha256(*stored) != recorded:
            self.damaged.add(key)
            return None
        data, scale, offset = stored
        if key[0] == ELEVATION_TABLE and self._first_format:
            return _heights(format_v1.heights(data))
        if scale is not None and offset is not None:
            image = _decoded(data)
            assert image.shape == (DEM_TILE_PX, DEM_TILE_PX) and image.dtype == np.uint16
            return _heights(np.where(image == DEM_NULL, np.nan, image * scale + offset).astype(np.float32))
        return picture_of(data)


def picture_of(data: bytes) -> Tile:
    """Pixels of a whole tile of imagery or descriptors, as ``TileStore.tile``."""
    image = _decoded(data)
    if image.ndim == 2:
        return image, True
    if image.shape[2] == 4:
        image[:, :, 3] = np.where(image[:, :, 3] > 0, 255, 0)
        whole = bool((image[:, :, 3] == 255).all())
        return (np.ascontiguousarray(image[:, :, :3]), True) if whole else (image, False)
    return image, True


def put_picture(tile: Tile, part: Part, out: np.ndarray) -> None:
    """Copies a part of a tile of imagery into ``out`` (h, w, 4)."""
    pixels, whole = tile
    if whole:
        cv2.cvtColor(pixels[part], cv2.COLOR_BGR2BGRA, dst=out)
    else:
        out[:] = pixels[part]


def _decoded(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None, "a tile has its sha256 and does not decode"
    return image


def _heights(height_m: np.ndarray) -> Tile:
    return height_m, bool(np.isfinite(height_m).all())


def _size(tile: Tile | None) -> int:
    return VOID_BYTES if tile is None else tile[0].nbytes
