"""Finds the collar of an image without a mask: uniform black or white areas that are connected to its border."""

import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.transform import Affine
from rasterio.windows import Window

from terrafix_tools.mapping.imagery import Imagery

BLOCK_PX = 2048  # side of the blocks that are labelled one at a time
SIDES = ((-1, 0), (1, 0), (0, -1), (0, 1))  # left, right, above, below a block
MIN_COLLAR_PX = 256  # smaller areas at the border are shadow, glare or compression noise
GAP_PX = 9  # a white collar inside a black one is separated by a blurred line that is narrower than this
BLEED_PX = 16  # lossy compression smears the edge of a collar over its block (JPEG in YCbCr 4:2:0: 16 px)
TRIM_PX = 4  # the last pixels before the edge are mixed with the collar and always removed
REACH_PX = BLEED_PX + TRIM_PX
BLEED_LEVEL = 16  # smeared pixels are within this of black or white

Block = tuple[int, int]  # column and row of a block; also a step to the next


class Collar:
    """Mask of the collar, in a one-bit temporary image, so that memory is bounded."""

    def __init__(self, path: Path) -> None:
        self._file = rasterio.open(path)

    def remove(self, image: np.ndarray, mask: np.ndarray, column: int, row: int) -> None:
        """Marks collar pixels and the smear beside them invalid in the mask of a window that has a margin."""
        empty = self._file.read(1, window=Window(column, row, mask.shape[1], mask.shape[0]))
        if not empty.any():
            return
        # Only around the collar: most of a window has none.
        left, top, width, height = cv2.boundingRect(empty)
        near = (
            slice(max(0, top - REACH_PX), top + height + REACH_PX),
            slice(max(0, left - REACH_PX), left + width + REACH_PX),
        )
        image, mask, empty = image[near], mask[near], empty[near]
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
    """Collar of an image; None when there is none. Writes `scratch`, which remains. ``bar(name, steps) -> step()``."""
    rim = _border_blocks(source)
    if not rim:
        return None
    blocks = _ReachedBlocks(source, rim, bar)
    chosen = blocks.sets.collar()
    if not chosen.any():
        return None
    placement = Affine(source.pixel_x, 0, source.x_min, 0, -source.pixel_y, source.y_max)
    profile: dict[str, Any] = {"driver": "GTiff", "width": source.width_px, "height": source.height_px, "count": 1}
    profile |= {"dtype": "uint8", "crs": source.crs.to_wkt(), "transform": placement, "tiled": True, "nbits": 1}
    profile |= {"blockxsize": 256, "blockysize": 256, "compress": "deflate", "BIGTIFF": "IF_SAFER", "SPARSE_OK": True}
    with rasterio.open(scratch, "w", **profile) as out:
        for place, first in blocks.first.items():
            labels = cv2.connectedComponents(blocks.empty(place), connectivity=4)[1]
            belongs = np.concatenate([[False], chosen[first + 1 : first + 1 + int(labels.max())]])
            if belongs.any():  # other blocks stay unwritten, which reads as zero
                x, y = place[0] * BLOCK_PX, place[1] * BLOCK_PX
                out.write(belongs.astype(np.uint8)[labels], 1, window=Window(x, y, labels.shape[1], labels.shape[0]))
    return Collar(scratch)


class _ReachedBlocks:
    """The blocks with empty areas that are connected to the image's border; other blocks are not read."""

    def __init__(self, source: Imagery, rim: set[Block], bar: Callable[[str, int | None], Callable[[], None]]) -> None:
        self.sets = _DisjointSets()
        self.first: dict[Block, int] = {}  # label offset of a block
        self._packed: dict[Block, tuple[tuple[int, int], bytes]] = {}  # shape and compressed bits of its empty areas
        self._lines: dict[tuple[Block, Block], np.ndarray] = {}  # labels along a block's side, by block and direction
        self._columns, self._rows = -(-source.width_px // BLOCK_PX), -(-source.height_px // BLOCK_PX)
        on_step = bar("collar", None)
        wanted = sorted(rim)
        while wanted:
            for place in wanted:
                self._add(source, place)
                on_step()
            wanted = sorted(self._next())

    def empty(self, place: Block) -> np.ndarray:
        """(h, w) uint8: 1 in the empty areas of a block."""
        shape, packed = self._packed[place]
        bits = np.frombuffer(zlib.decompress(packed), np.uint8)
        return np.unpackbits(bits, count=shape[0] * shape[1]).reshape(shape)

    def _add(self, source: Imagery, place: Block) -> None:
        first = self.first[place] = len(self.sets.parent) - 1
        empty = _empty_areas(source, place)
        # Kept, because reading them again takes five times as long; a block becomes a few kilobytes.
        self._packed[place] = (empty.shape[0], empty.shape[1]), zlib.compress(np.packbits(empty).tobytes(), level=1)
        labels = cv2.connectedComponents(empty, connectivity=4)[1]
        self.sets.add(np.bincount(labels[empty > 0])[1:])
        for side in SIDES:
            line = _line(labels, side)
            line = np.where(line > 0, line + first, 0)
            self._lines[place, side] = line
            beside = place[0] + side[0], place[1] + side[1]
            if not (0 <= beside[0] < self._columns and 0 <= beside[1] < self._rows):
                self.sets.touch_border(line)
            elif beside in self.first:
                self.sets.join(line, self._lines[beside, (-side[0], -side[1])])

    def _next(self) -> set[Block]:
        """Unread neighbour blocks of areas that touch the image's border."""
        roots = self.sets.border_roots()
        found: set[Block] = set()
        for (place, side), line in self._lines.items():
            beside = place[0] + side[0], place[1] + side[1]
            inside = 0 <= beside[0] < self._columns and 0 <= beside[1] < self._rows
            if not inside or beside in self.first or beside in found:
                continue
            if any(self.sets.find(int(label)) in roots for label in np.unique(line) if label):
                found.add(beside)
        return found


def _line(labels: np.ndarray, side: Block) -> np.ndarray:
    """First or last column or row of a block, on the side ``side``."""
    if side[0]:
        return labels[:, 0 if side[0] < 0 else -1]
    return labels[0 if side[1] < 0 else -1]


def _empty(image: np.ndarray, tolerance: int) -> np.ndarray:
    """(h, w) uint8: 1 where a BGR pixel is black or white within the tolerance."""
    black = cv2.inRange(image, (0, 0, 0), (tolerance,) * 3)
    white = cv2.inRange(image, (255 - tolerance,) * 3, (255,) * 3)
    return cv2.threshold(cv2.bitwise_or(black, white), 0, 1, cv2.THRESH_BINARY)[1]


def _border_blocks(source: Imagery) -> set[Block]:
    """Blocks at the image's border with empty pixels there; none when no border pixel is empty."""
    width, height = source.width_px, source.height_px
    deep = min(GAP_PX // 2 + 1, width, height)  # an area within the gap is connected to the border
    bands = (
        (0, 0, width, deep),
        (0, height - deep, width, deep),
        (0, 0, deep, height),
        (width - deep, 0, deep, height),
    )
    found: set[Block] = set()
    touched = False
    for column, row, across, down in bands:
        empty = _empty(source.read(column, row, across, down)[0], 0)
        rows, columns = np.nonzero(empty)
        rows, columns = rows + row, columns + column
        touched |= bool(((rows == 0) | (rows == height - 1) | (columns == 0) | (columns == width - 1)).any())
        found |= set(zip((columns // BLOCK_PX).tolist(), (rows // BLOCK_PX).tolist(), strict=True))
    return found if touched else set()


class _DisjointSets:
    """Union-find over the labels of all blocks, with their sizes. Label 0 is image content."""

    def __init__(self) -> None:
        self.parent = [0]
        self.size_px = [0]
        self._border: set[int] = set()

    def add(self, sizes_px: np.ndarray) -> None:
        """Registers the labels of a block in order."""
        first = len(self.parent)
        self.parent.extend(range(first, first + len(sizes_px)))
        self.size_px.extend(int(s) for s in sizes_px)

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

    def border_roots(self) -> set[int]:
        """Roots of the areas that touch the border of the image."""
        return {self.find(label) for label in self._border}

    def collar(self) -> np.ndarray:
        """(labels,) bool: part of an empty area at the border with the minimum size."""
        roots = {root for root in self.border_roots() if self.size_px[root] >= MIN_COLLAR_PX}
        return np.array([label > 0 and self.find(label) in roots for label in range(len(self.parent))])


def _empty_areas(source: Imagery, place: Block) -> np.ndarray:
    """(h, w) uint8: 1 in the empty areas of a block, with the gaps between them closed."""
    column, row = place[0] * BLOCK_PX, place[1] * BLOCK_PX
    width, height = min(BLOCK_PX, source.width_px - column), min(BLOCK_PX, source.height_px - row)
    empty = _empty(source.read(column, row, width, height)[0], 0)
    return cv2.morphologyEx(empty, cv2.MORPH_CLOSE, np.ones((GAP_PX, GAP_PX), np.uint8))
