"""Finds the collar of an image without a mask: pure black or white areas that are connected to its border."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window

from terrafix_tools.mapping.layers import Imagery

BLOCK_PX = 2048  # labelled at a time
MIN_COLLAR_PX = 256  # less than this at the border is shadow, glare or compression noise
GAP_PX = 9  # a white collar inside a black one is parted from it by a smeared line, narrower than this
BLEED_PX = 16  # lossy compression smears the edge of a collar over its block (JPEG in YCbCr 4:2:0: 16 px)
TRIM_PX = 4  # and mixes the last pixels before the edge with it, whatever they look like
BLEED_LEVEL = 16  # smeared pixels are still this close to black or white


class Collar:
    """Mask of the collar, kept in a one-bit temporary image so that memory stays bounded."""

    def __init__(self, path: Path) -> None:
        self._file = rasterio.open(path)

    def remove(self, image: np.ndarray, mask: np.ndarray, column: int, row: int) -> None:
        """Marks collar pixels, and the smear beside them, invalid in the mask of a window read with a margin."""
        empty = self._file.read(1, window=Window(column, row, mask.shape[1], mask.shape[0]))
        if not empty.any():
            return
        smeared = _empty(image, BLEED_LEVEL)
        kernel = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
        for _ in range(BLEED_PX):
            grown = cv2.dilate(empty, kernel) & smeared
            grown |= empty
            if np.array_equal(grown, empty):
                break
            empty = grown
        mask[cv2.dilate(empty, np.ones((2 * TRIM_PX + 1, 2 * TRIM_PX + 1), np.uint8)) > 0] = 0

    def close(self) -> None:
        self._file.close()


def find_collar(source: Imagery, scratch: Path, bar: Callable[[str, int | None], Callable[[], None]]) -> Collar | None:
    """Collar of an image, or None when there is none. Writes and leaves `scratch`. ``bar(name, steps) -> step()``."""
    if not _border_is_empty(source):
        return None
    width, height = source.width_px, source.height_px
    on_step = bar("collar", 2 * math.ceil(width / BLOCK_PX) * math.ceil(height / BLOCK_PX))
    sets = _DisjointSets()
    above: dict[int, np.ndarray] = {}  # labels of the last line of the block row above, by block column
    for block_row in range(0, height, BLOCK_PX):
        left: np.ndarray | None = None
        for block_column in range(0, width, BLOCK_PX):
            labels = _labels(source, block_column, block_row, sets)
            on_step()
            if block_column == 0:
                sets.touch_border(labels[:, 0])
            if block_row == 0:
                sets.touch_border(labels[0])
            if block_column + labels.shape[1] == width:
                sets.touch_border(labels[:, -1])
            if block_row + labels.shape[0] == height:
                sets.touch_border(labels[-1])
            if left is not None:
                sets.join(left, labels[:, 0])
            if block_row > 0:
                sets.join(above[block_column], labels[0])
            left, above[block_column] = labels[:, -1].copy(), labels[-1].copy()
    chosen = sets.collar()
    if not chosen.any():
        return None
    placement = Affine(source.pixel_x, 0, source.x_min, 0, -source.pixel_y, source.y_max)
    profile: dict[str, Any] = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "uint8"}
    profile |= {"crs": source.crs.to_wkt(), "transform": placement, "tiled": True, "blockxsize": 256}
    profile |= {"blockysize": 256, "compress": "deflate", "nbits": 1, "BIGTIFF": "IF_SAFER"}
    numbering = _DisjointSets()
    with rasterio.open(scratch, "w", **profile) as out:
        for block_row in range(0, height, BLOCK_PX):
            for block_column in range(0, width, BLOCK_PX):
                labels = _labels(source, block_column, block_row, numbering)  # the same numbers as before
                window = Window(block_column, block_row, labels.shape[1], labels.shape[0])
                out.write(chosen[labels].astype(np.uint8), 1, window=window)
                on_step()
    return Collar(scratch)


def _empty(image: np.ndarray, tolerance: int) -> np.ndarray:
    """(h, w) uint8, 1 where a BGR pixel is black or white within the tolerance."""
    black = cv2.inRange(image, (0, 0, 0), (tolerance,) * 3)
    white = cv2.inRange(image, (255 - tolerance,) * 3, (255,) * 3)
    return ((black > 0) | (white > 0)).astype(np.uint8)


def _border_is_empty(source: Imagery) -> bool:
    width, height = source.width_px, source.height_px
    edges = ((0, 0, width, 1), (0, height - 1, width, 1), (0, 0, 1, height), (width - 1, 0, 1, height))
    return any(bool(_empty(source.read(*edge)[0], 0).any()) for edge in edges)


class _DisjointSets:
    """Union-find over the labels of all blocks, with their sizes. Label 0 is picture."""

    def __init__(self) -> None:
        self.parent = [0]
        self.size_px = [0]
        self._border: set[int] = set()

    def add(self, sizes_px: np.ndarray) -> int:
        """Registers the labels of a block; returns the number to add to them."""
        first = len(self.parent) - 1
        self.parent.extend(range(first + 1, first + 1 + len(sizes_px)))
        self.size_px.extend(int(s) for s in sizes_px)
        return first

    def find(self, label: int) -> int:
        while self.parent[label] != label:
            self.parent[label] = self.parent[self.parent[label]]
            label = self.parent[label]
        return label

    def join(self, a: np.ndarray, b: np.ndarray) -> None:
        both = (a > 0) & (b > 0)
        for one, other in np.unique(np.stack([a[both], b[both]], axis=1), axis=0):
            root, child = sorted((self.find(int(one)), self.find(int(other))))
            if root != child:
                self.parent[child] = root
                self.size_px[root] += self.size_px[child]

    def touch_border(self, labels: np.ndarray) -> None:
        self._border.update(int(label) for label in np.unique(labels) if label)

    def collar(self) -> np.ndarray:
        """(labels,) bool: belongs to an empty area at the border that is large enough."""
        roots = {self.find(label) for label in self._border}
        roots = {root for root in roots if self.size_px[root] >= MIN_COLLAR_PX}
        return np.array([label > 0 and self.find(label) in roots for label in range(len(self.parent))])


def _labels(source: Imagery, column: int, row: int, sets: _DisjointSets) -> np.ndarray:
    """(h, w) int32 labels of the empty areas of one block, numbered on through all blocks; 0 = picture."""
    width, height = min(BLOCK_PX, source.width_px - column), min(BLOCK_PX, source.height_px - row)
    empty = _empty(source.read(column, row, width, height)[0], 0)
    closed = cv2.morphologyEx(empty, cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=4)
    first = sets.add(stats[1:, cv2.CC_STAT_AREA])
    return np.where(labels > 0, labels + first, 0) if count > 1 else labels
