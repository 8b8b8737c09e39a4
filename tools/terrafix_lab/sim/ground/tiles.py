"""Image pyramid of any size in tiles that are created on demand and cached with bounded memory.

Level 0 is the image itself; each further level has half the resolution, which avoids aliasing in a high or oblique
view.
"""

from collections import OrderedDict
from collections.abc import Callable

import cv2
import numpy as np

TILE_PX = 1024
CACHE_BYTES = 160 << 20  # about 50 colour tiles: several times what a flight at any height sees at once
TOP_LEVEL = 8

# (level, column, row of a tile) -> its pixels; None: halve the finer level
Make = Callable[[int, int, int], np.ndarray | None]


class Pyramid:
    """Pixels (column, row) of ``level`` have their centres at integers; tile indices may be negative."""

    def __init__(self, make: Make, cache_bytes: int = CACHE_BYTES) -> None:
        """``make`` must provide every tile of level 0: (TILE_PX, TILE_PX[, 3]) uint8."""
        self._make = make
        self._limit = cache_bytes
        self._cache: OrderedDict[tuple[int, int, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def window(self, level: int, column: int, row: int, width: int, height: int) -> np.ndarray:
        """Returns (height, width[, 3]) uint8 from (column, row) of ``level`` on."""
        first = self._tile(level, column // TILE_PX, row // TILE_PX)
        out = np.empty((height, width, *first.shape[2:]), np.uint8)
        for j in range(row // TILE_PX, (row + height - 1) // TILE_PX + 1):
            for i in range(column // TILE_PX, (column + width - 1) // TILE_PX + 1):
                x0, y0 = i * TILE_PX - column, j * TILE_PX - row
                left, top = max(x0, 0), max(y0, 0)
                right, bottom = min(x0 + TILE_PX, width), min(y0 + TILE_PX, height)
                out[top:bottom, left:right] = self._tile(level, i, j)[top - y0 : bottom - y0, left - x0 : right - x0]
        return out

    def _tile(self, level: int, i: int, j: int) -> np.ndarray:
        key = (level, i, j)
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        tile = self._uncached_tile(level, i, j)
        self._cache[key] = tile
        self._bytes += tile.nbytes
        while self._bytes > self._limit and len(self._cache) > 1:
            self._bytes -= self._cache.popitem(last=False)[1].nbytes
        return tile

    def _uncached_tile(self, level: int, i: int, j: int) -> np.ndarray:
        """Returns a tile without caching it: the fine tiles under a coarse one would displace those in use."""
        if (level, i, j) in self._cache:
            return self._cache[level, i, j]
        tile = self._make(level, i, j)
        return self._halved(level, i, j) if tile is None else tile

    def _halved(self, level: int, i: int, j: int) -> np.ndarray:
        half = TILE_PX // 2
        quarters = [
            [
                cv2.resize(
                    np.ascontiguousarray(self._uncached_tile(level - 1, 2 * i + a, 2 * j + b)),
                    (half, half),
                    interpolation=cv2.INTER_AREA,
                )
                for a in (0, 1)
            ]
            for b in (0, 1)
        ]
        return np.concatenate([np.concatenate(row, axis=1) for row in quarters], axis=0)


def level_for(step_px: float) -> int:
    """Returns the level whose pixels are about as large as the steps of a camera's pixels on level 0."""
    return int(np.clip(np.round(np.log2(max(step_px, 1e-6))), 0, TOP_LEVEL))


def outside(level: int, i: int, j: int, width: int, height: int) -> bool:
    """True if a tile does not overlap an image of that size."""
    side = TILE_PX << level
    return i < 0 or j < 0 or i * side >= width or j * side >= height


def blank(colour: np.ndarray) -> np.ndarray:
    """Returns a tile of one colour (3,), read-only, without own memory."""
    return np.broadcast_to(colour, (TILE_PX, TILE_PX, len(colour)))


def of_array(image: np.ndarray) -> Make:
    """Returns the tiles of an image in memory (H, W, 3) uint8, with its mean colour beyond it."""
    colour = image.reshape(-1, image.shape[2]).mean(axis=0).round().astype(np.uint8)

    def make(level: int, i: int, j: int) -> np.ndarray | None:
        if outside(level, i, j, image.shape[1], image.shape[0]):
            return blank(colour)
        if level > 0:
            return None
        part = image[j * TILE_PX : (j + 1) * TILE_PX, i * TILE_PX : (i + 1) * TILE_PX]
        if part.shape[:2] == (TILE_PX, TILE_PX):
            return part
        tile = blank(colour).copy()
        tile[: part.shape[0], : part.shape[1]] = part
        return tile

    return make
