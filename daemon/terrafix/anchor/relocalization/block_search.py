"""One frame against a whole region of the map: every place, heading and scale on coarse cells, block by block.

The measurement is that of the belief (zero-mean normalised correlation), of gradients pooled over cells and made cheap:
the denominator is a box sum that all headings and scales share, a block of the map is transformed once for all of them,
and of the surfaces only the best value of each cell is kept. Correlations are comparable over the whole map; in
standard deviations of its own block a dull block would look like a bright one."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.anchor.matching.descriptor_cache import Describer, MapWindows
from terrafix.anchor.matching.fft import spectra, transform_shape
from terrafix.anchor.matching.ncc import FLAT_VARIANCE, MIN_OVERLAP
from terrafix.anchor.matching.orthorectify import Rectified
from terrafix.anchor.relocalization.coarse_descriptors import TileIndex

BLOCK_CELLS = 256  # side of a block of camera positions: the tile of the search
AT_ONCE = 16  # templates whose transforms are held at a time: a few MB each


@dataclass(frozen=True)
class Template:
    """Ground as descriptors (C, h, w) with its mask (h, w), for one heading and scale; its corner lies at
    (e_min_m, n_max_m) from the point below the camera."""

    descriptors: np.ndarray
    mask: np.ndarray
    e_min_m: float
    n_max_m: float


@dataclass(frozen=True)
class Block:
    """Camera positions of cells [row, row + BLOCK_CELLS) x [column, column + BLOCK_CELLS) of the grid whose cell (0, 0)
    has its corner at local (0, 0), rows counted southwards."""

    row: int
    column: int


@dataclass(frozen=True)
class BlockLook:
    """``correlation``, ``index`` (BLOCK_CELLS, BLOCK_CELLS): the best one of each cell, and the template that gave it;
    NaN and 0 where the map does not cover the ground."""

    correlation: np.ndarray
    index: np.ndarray


@dataclass(frozen=True)
class _Prepared:
    """``transform`` (C, H, W // 2 + 1) of the zero-mean template, conjugate; ``own``: its energy, over ``count`` cells;
    row and column of its corner and of its middle in the window of a block."""

    transform: np.ndarray
    count: float
    own: float
    corner: tuple[int, int]
    middle: tuple[int, int]


def blocks_of(bounds_m: tuple[float, float, float, float], cell_m: float) -> list[Block]:
    """Blocks that cover (e_min, n_min, e_max, n_max)."""
    e_min, n_min, e_max, n_max = bounds_m
    columns = range(int(np.floor(e_min / cell_m)), int(np.ceil(e_max / cell_m)), BLOCK_CELLS)
    rows = range(int(np.floor(-n_max / cell_m)), int(np.ceil(-n_min / cell_m)), BLOCK_CELLS)
    return [Block(r, c) for r, c in itertools.product(rows, columns)]


class WideSearch:
    def __init__(self, source: MapWindows, describer: Describer) -> None:
        self._describer = describer
        self._features = TileIndex(source, describer)
        self.stride = describer.stride  # pixels of a cell's side

    def cell_m(self, wanted_m: float) -> float:
        """Of the cells that cost least near the wanted size."""
        return self._features.gsd_m(wanted_m / self.stride) * self.stride

    def describe(self, frame: Rectified) -> Template:
        h, w = (side // self.stride for side in frame.mask.shape)
        mask = np.asarray(frame.mask.reshape(h, self.stride, w, self.stride).all(axis=(1, 3)))
        return Template(self._describer.describe(frame.image), mask, frame.e_min_m, frame.n_max_m)

    def look(self, templates: Sequence[Template], blocks: Sequence[Block], cell_m: float) -> list[BlockLook]:
        """One answer for each block. All templates are rectified with ``stride`` pixels to ``cell_m``."""
        # What a template covers while the camera is in the first cell of a block: rows and columns from that cell.
        corners = [(round(-t.n_max_m / cell_m), round(t.e_min_m / cell_m)) for t in templates]
        ends = [(r + t.mask.shape[0], c + t.mask.shape[1]) for t, (r, c) in zip(templates, corners, strict=True)]
        low_r, low_c = (min(corner[axis] for corner in corners) for axis in (0, 1))
        height, width = (BLOCK_CELLS + max(end[k] for end in ends) - low for k, low in ((0, low_r), (1, low_c)))
        fft = transform_shape(height, width)
        found = [_nothing() for _ in blocks]
        for begin in range(0, len(templates), AT_ONCE):
            chunk = range(begin, min(begin + AT_ONCE, len(templates)))
            prepared = [_prepare(templates[i], (corners[i][0] - low_r, corners[i][1] - low_c), fft) for i in chunk]
            for look, block in zip(found, blocks, strict=True):
                e_min_m, n_max_m = (block.column + low_c) * cell_m, -(block.row + low_r) * cell_m
                descriptors, valid, _, _ = self._features.window(e_min_m, n_max_m, width, height, cell_m / self.stride)
                if not valid.any():
                    continue
                spectrum = spectra(descriptors, fft)
                under = _box_sums(descriptors, valid, prepared[0].count)
                for i, template in zip(chunk, prepared, strict=True):
                    product = np.fft.irfft2((spectrum * template.transform).sum(0), fft)
                    correlation = _normalised(product, template, under)
                    better = correlation > look.correlation
                    np.copyto(look.correlation, correlation, where=better)
                    np.copyto(look.index, np.uint8(i), where=better)
        for look in found:
            look.correlation[np.isneginf(look.correlation)] = np.nan
        return found


def _nothing() -> BlockLook:
    side = (BLOCK_CELLS, BLOCK_CELLS)
    return BlockLook(np.full(side, -np.inf, np.float32), np.zeros(side, np.uint8))


def _prepare(template: Template, corner: tuple[int, int], fft: tuple[int, int]) -> _Prepared:
    weight = template.mask.astype(np.float32)
    count = float(weight.sum())
    mean = (template.descriptors * weight).sum((1, 2)) / count
    centred = (template.descriptors - mean[:, None, None]) * weight
    middle = tuple(round(float(v.mean())) for v in np.nonzero(template.mask))
    return _Prepared(
        spectra(centred, fft).conj(),
        count,
        float((centred**2).sum()),
        corner,
        (corner[0] + middle[0], corner[1] + middle[1]),
    )


def _normalised(product: np.ndarray, template: _Prepared, under: tuple[np.ndarray, ...]) -> np.ndarray:
    """Zero-mean normalised correlation of each camera position of the block. ``under``: of ``_box_sums``, read where
    the middle of the template lies. -inf where the map does not cover the ground."""
    (r, c), (rm, cm) = template.corner, template.middle
    middle = (slice(rm, rm + BLOCK_CELLS), slice(cm, cm + BLOCK_CELLS))
    energy, squares, known = (sums[middle] for sums in under)
    variance = np.maximum((energy - squares) * template.count, FLAT_VARIANCE * template.own)
    correlation = product[r : r + BLOCK_CELLS, c : c + BLOCK_CELLS] / np.sqrt(
        np.maximum(variance * template.own, 1e-12)
    )
    correlation[known < MIN_OVERLAP] = -np.inf
    return np.asarray(correlation)


def _box_sums(descriptors: np.ndarray, valid: np.ndarray, count: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over a square of ``count`` cells around each: energy, squared channel means, share that is valid."""
    side = max(round(float(np.sqrt(count))), 1) | 1
    box = (side, side)
    energy = cv2.boxFilter(np.einsum("khw,khw->hw", descriptors, descriptors), -1, box, borderType=cv2.BORDER_CONSTANT)
    squares = np.zeros_like(energy)
    for channel in descriptors:
        squares += cv2.boxFilter(channel, -1, box, borderType=cv2.BORDER_CONSTANT) ** 2
    ok = cv2.boxFilter(valid.astype(np.float32), -1, box, borderType=cv2.BORDER_CONSTANT)
    return energy, squares, ok
