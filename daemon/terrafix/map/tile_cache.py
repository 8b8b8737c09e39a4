"""Tiles of an open map package: read, verified against their sha256, decoded, and cached up to a memory limit."""

import sqlite3
from collections import OrderedDict
from collections.abc import Iterator

import cv2
import numpy as np

from terrafix.map.format import DEM_NULL, DEM_TILE_PX, ELEVATION_TABLE, HASH_TABLE, TILE_PX, HashRow, Level, tile_sha256

TILE_CACHE_BYTES = 32_000_000  # decoded tiles; about 160; a window of 1 km needs 80 at 0.5 m/px and 320 at 0.24 m/px
VOID_BYTES = 100  # cost of a missing tile in the cache, so that the number of missing tiles is bounded, too

Key = tuple[str, int, int, int]  # table, zoom, column, row
Tile = tuple[np.ndarray, bool]  # pixels; whether all pixels are valid
Part = tuple[slice, slice]  # rows and columns


class TileStore:
    """Decoded tiles. A damaged tile counts as missing and is listed in ``damaged``."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self.damaged: set[Key] = set()
        self._cache: OrderedDict[Key, Tile | None] = OrderedDict()
        self._cached_bytes = 0

    def tile(self, key: Key) -> Tile | None:
        """One tile, or None when it is missing.

        Imagery: (256, 256, 3) uint8 BGR and True when all pixels are valid, else (256, 256, 4) with a mask of 0 and 255
        in the fourth channel and False. Elevation: (256, 256) float32 metres AMSL, NaN = void. Descriptors: (height,
        width) uint8 as stored (``format.DescriptorTable``)."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        tile = self._load(key)
        self._cache[key] = tile
        self._cached_bytes += _size(tile)
        while self._cached_bytes > TILE_CACHE_BYTES:
            self._cached_bytes -= _size(self._cache.popitem(last=False)[1])
        return tile

    def mosaic(self, table: str, level: Level, u_0: int, v_0: int, width: int, height: int) -> Tile:
        """Pixels [v_0, v_0 + height) x [u_0, u_0 + width) of a level: (height, width, 4), and whether all are valid.

        Areas without tiles are zero."""
        image = np.empty((height, width, 4), np.uint8)
        all_valid = True
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
                    all_valid = False
                else:
                    across = slice(columns.start - left, columns.stop - left)
                    copy_tile_part(tile, (slice(rows.start - top, rows.stop - top), across), image[rows, columns])
                    all_valid &= tile[1]
        return image, all_valid

    def hashes(self) -> Iterator[HashRow]:
        """Recorded hashes of all tiles, in order."""
        yield from self._db.execute(f"SELECT table_name, zoom_level, tile_column, tile_row, sha256 FROM {HASH_TABLE}")

    def matches_hash(self, key: Key, sha256: bytes) -> bool:
        """True when the tile exists and matches ``sha256``."""
        found = self._read_tile(key)
        return found is not None and tile_sha256(*found) == sha256

    def clear(self) -> None:
        self._cache.clear()
        self._cached_bytes = 0

    def _read_tile(self, key: Key) -> tuple[bytes, float | None, float | None] | None:
        """Encoded bytes of a tile; scale and offset for elevation, else None. None: no such tile, or an empty one."""
        table, zoom, column, row = key
        if table != ELEVATION_TABLE:
            found = self._db.execute(
                f'SELECT CAST(tile_data AS BLOB) FROM "{table}"'
                " WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
                (zoom, column, row),
            ).fetchone()
            return None if found is None or None in found else (found[0], None, None)
        found = self._db.execute(
            f"SELECT CAST(tile_data AS BLOB), scale, offset FROM {ELEVATION_TABLE}"
            " JOIN gpkg_2d_gridded_tile_ancillary"
            f" ON tpudt_name = '{ELEVATION_TABLE}' AND tpudt_id = {ELEVATION_TABLE}.id"
            " WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?",
            (zoom, column, row),
        ).fetchone()
        return None if found is None or None in found else (found[0], float(found[1]), float(found[2]))

    def _read_hash(self, key: Key) -> bytes | None:
        """Recorded sha256 of a tile; None: no such tile."""
        found = self._db.execute(
            f"SELECT sha256 FROM {HASH_TABLE}"
            " WHERE table_name = ? AND zoom_level = ? AND tile_column = ? AND tile_row = ?",
            key,
        ).fetchone()
        return None if found is None else found[0]

    def _load(self, key: Key) -> Tile | None:
        """Reads, verifies and decodes a tile; adds it to ``damaged`` on a mismatch or a read error."""
        try:
            expected, stored = self._read_hash(key), self._read_tile(key)
        except (sqlite3.DatabaseError, ValueError):  # damaged database page
            self.damaged.add(key)
            return None
        if expected is None and stored is None:
            return None
        if expected is None or stored is None or tile_sha256(*stored) != expected:
            self.damaged.add(key)
            return None
        data, scale, offset = stored
        if scale is not None and offset is not None:
            image = _decode_image(data)
            assert image.shape == (DEM_TILE_PX, DEM_TILE_PX) and image.dtype == np.uint16
            return _elevation_tile(np.where(image == DEM_NULL, np.nan, image * scale + offset).astype(np.float32))
        return decode_tile(data)


def decode_tile(data: bytes) -> Tile:
    """Decodes a tile of imagery or descriptors; result as ``TileStore.tile``."""
    image = _decode_image(data)
    if image.ndim == 2:
        return image, True
    if image.shape[2] == 4:
        image[:, :, 3] = np.where(image[:, :, 3] > 0, 255, 0)
        all_valid = bool((image[:, :, 3] == 255).all())
        return (np.ascontiguousarray(image[:, :, :3]), True) if all_valid else (image, False)
    return image, True


def copy_tile_part(tile: Tile, part: Part, out: np.ndarray) -> None:
    """Copies a part of an imagery tile into ``out`` (h, w, 4) uint8 BGRA."""
    pixels, all_valid = tile
    if all_valid:
        cv2.cvtColor(pixels[part], cv2.COLOR_BGR2BGRA, dst=out)
    else:
        out[:] = pixels[part]


def _decode_image(data: bytes) -> np.ndarray:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert image is not None, "a tile has its sha256 and does not decode"
    return image


def _elevation_tile(height_m: np.ndarray) -> Tile:
    return height_m, bool(np.isfinite(height_m).all())


def _size(tile: Tile | None) -> int:
    return VOID_BYTES if tile is None else tile[0].nbytes
