"""A picture of any size in tiles that are made when somebody looks, and forgotten again: memory stays bounded.

Level 0 is the picture itself; each further level has half the resolution, so that a high or oblique view does not
alias."""

from collections import OrderedDict
from collections.abc import Callable

import cv2
import numpy as np

TILE_PX = 1024
CACHE_BYTES = 160 << 20  # about 50 colour tiles: what a flight at any height sees at once, several times over
TOP_LEVEL = 8

Make = Callable[[int, int, int], np.ndarray | None]  # level, column and row of a tile -> its pixels; None: by halving


class Pyramid:
    """Pixels (column, row) of ``level`` have their centres at whole numbers; tiles may have any index, also below 0."""

    def __init__(self, make: Make, cache_bytes: int = CACHE_BYTES) -> None:
        """``make`` must know every tile of level 0: (TILE_PX, TILE_PX[, 3]) uint8."""
        self._make = make
        self._limit = cache_bytes
        self._kept: OrderedDict[tuple[int, int, int], np.ndarray] = OrderedDict()
        self._bytes = 0

    def window(self, level: int, column: int, row: int, width: int, height: int) -> np.ndarray:
        """(height, width[, 3]) uint8 from (column, row) of ``level`` on."""
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
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        tile = self._made(level, i, j)
        self._kept[key] = tile
        self._bytes += tile.nbytes
        while self._bytes > self._limit and len(self._kept) > 1:
            self._bytes -= self._kept.popitem(last=False)[1].nbytes
        return tile

    def _made(self, level: int, i: int, j: int) -> np.ndarray:
        """Not kept: the fine tiles under a coarse one would drive out what is looked at."""
        if (level, i, j) in self._kept:
            return self._kept[level, i, j]
        tile = self._make(level, i, j)
        return self._halved(level, i, j) if tile is None else tile

    def _halved(self, level: int, i: int, j: int) -> np.ndarray:
        half = TILE_PX // 2
        quarters = [
            [
                cv2.resize(
                    np.ascontiguousarray(self._made(level - 1, 2 * i + a, 2 * j + b)),
                    (half, half),
                    interpolation=cv2.INTER_AREA,
                )
                for a in (0, 1)
            ]
            for b in (0, 1)
        ]
        return np.concatenate([np.concatenate(row, axis=1) for row in quarters], axis=0)


def level_for(step_px: float) -> int:
    """The level whose pixels are about as large as the steps of a camera's pixels on level 0."""
    return int(np.clip(np.round(np.log2(max(step_px, 1e-6))), 0, TOP_LEVEL))


def outside(level: int, i: int, j: int, width: int, height: int) -> bool:
    """Whether a tile has nothing of a picture of that size."""
    side = TILE_PX << level
    return i < 0 or j < 0 or i * side >= width or j * side >= height


def blank(colour: np.ndarray) -> np.ndarray:
    """A tile of one colour (3,), read-only: it takes no memory."""
    return np.broadcast_to(colour, (TILE_PX, TILE_PX, len(colour)))


def of_array(image: np.ndarray) -> Make:
    """Tiles of a picture in memory (H, W, 3) uint8; beyond it the ground has its mean colour."""
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
