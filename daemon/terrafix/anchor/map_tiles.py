"""Tiles of an open map package: fetched, checked against their sha256, decoded and kept in a bounded cache."""

import hashlib
import sqlite3
import zlib
from collections import OrderedDict

import cv2
import numpy as np

from terrafix.anchor.map_format import DEM_TABLE, DEM_TILE_PX, HASH_TABLE, IMAGERY_TABLE, TILE_PX, Level

CACHE_BYTES = 100_000_000  # decoded tiles; about 500, a window of 1 km at 0.5 m/px needs about 100
VOID_BYTES = 100  # what a void costs in the cache, so that a walk through nothing is bounded too

Key = tuple[int, int, int]  # zoom (-1 = elevation), column, row
Tile = tuple[np.ndarray, np.ndarray | None]  # pixels; mask of 0 and 255, or None when every pixel is valid


class TileStore:
    """Decoded tiles. A tile that is damaged is void and listed in ``damaged``."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self.damaged: set[Key] = set()
        self._cache: OrderedDict[Key, Tile | None] = OrderedDict()
        self._cached_bytes = 0

    def tile(self, key: Key) -> Tile | None:
        """(256, 256, 3) uint8 BGR and (256, 256) uint8 mask or None; None = nothing there.

        Elevation (zoom -1): (257, 257) float32 metres AMSL, NaN = void, and no mask."""
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        tile = self._decode(key)
        self._cache[key] = tile
        self._cached_bytes += _size(tile)
        while self._cached_bytes > CACHE_BYTES:
            self._cached_bytes -= _size(self._cache.popitem(last=False)[1])
        return tile

    def mosaic(self, level: Level, u_0: int, v_0: int, width: int, height: int) -> Tile:
        """Pixels [v_0, v_0 + height) x [u_0, u_0 + width) of a level and their mask, or None when all are valid."""
        image = np.empty((height, width, 3), np.uint8)
        mask: np.ndarray | None = None
        for row in range(v_0 // TILE_PX, (v_0 + height - 1) // TILE_PX + 1):
            for column in range(u_0 // TILE_PX, (u_0 + width - 1) // TILE_PX + 1):
                left, top = column * TILE_PX - u_0, row * TILE_PX - v_0
                target = (
                    slice(max(top, 0), min(top + TILE_PX, height)),
                    slice(max(left, 0), min(left + TILE_PX, width)),
                )
                inside = 0 <= column < level.columns and 0 <= row < level.rows
                tile = self.tile((level.zoom, column, row)) if inside else None
                if mask is None and (tile is None or tile[1] is not None):
                    mask = np.full((height, width), 255, np.uint8)
                if tile is None:
                    image[target] = 0
                    assert mask is not None
                    mask[target] = 0
                    continue
                part = (
                    slice(target[0].start - top, target[0].stop - top),
                    slice(target[1].start - left, target[1].stop - left),
                )
                image[target] = tile[0][part]
                if mask is not None and tile[1] is not None:
                    mask[target] = tile[1][part]
        return image, mask

    def blob(self, key: Key) -> bytes | None:
        """The bytes as stored."""
        args: tuple[int, ...] = key
        if key[0] < 0:
            query, args = f"SELECT tile_data FROM {DEM_TABLE} WHERE tile_column = ? AND tile_row = ?", key[1:]
        else:
            query = f"SELECT tile_data FROM {IMAGERY_TABLE} WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?"
        found = self._db.execute(query, args).fetchone()
        return None if found is None else found[0]

    def clear(self) -> None:
        self._cache.clear()
        self._cached_bytes = 0

    def _decode(self, key: Key) -> Tile | None:
        try:
            row = self._db.execute(
                f"SELECT sha256 FROM {HASH_TABLE} WHERE zoom_level = ? AND tile_column = ? AND tile_row = ?", key
            ).fetchone()
            data = self.blob(key)
        except sqlite3.DatabaseError:  # a bad page on the disk
            self.damaged.add(key)
            return None
        if row is None and data is None:
            return None
        if row is None or data is None or hashlib.sha256(data).digest() != row[0]:
            self.damaged.add(key)
            return None
        if key[0] < 0:
            side = DEM_TILE_PX + 1
            return np.frombuffer(zlib.decompress(data), dtype="<f4").reshape(side, side), None
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        assert image is not None, f"tile {key} has its sha256 and does not decode"
        if image.shape[2] == 4:
            return np.ascontiguousarray(image[:, :, :3]), np.where(image[:, :, 3] > 0, 255, 0).astype(np.uint8)
        return image, None


def _size(tile: Tile | None) -> int:
    if tile is None:
        return VOID_BYTES
    return tile[0].nbytes + (0 if tile[1] is None else tile[1].nbytes)
