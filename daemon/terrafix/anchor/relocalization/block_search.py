"""Correlation of a template with a region of the map on coarse cells: all positions, yaws and scales, block by block.

The measure is that of the belief, zero-mean normalised correlation, on gradients pooled over cells. Three things make
it cheap: the denominator is a box sum shared by all yaws and scales, each block of the map is transformed once for all
of them, and only the best value of each cell is kept. Correlations are comparable over the whole map. They are not
standardised per block, because that would amplify blocks with little texture.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.anchor.matching.descriptor_cache import Describer, MapWindows
from terrafix.anchor.matching.fft import cross_correlation, spectra, template_spectra, transform_shape
from terrafix.anchor.matching.ncc import FLAT_VARIANCE, MIN_OVERLAP
from terrafix.anchor.matching.orthorectify import Rectified
from terrafix.anchor.relocalization.coarse_descriptors import CoarseDescriptors

BLOCK_CELLS = 256  # side in cells of a block of camera positions, the tile of the search [tuned]
CHUNK_TEMPLATES = 16  # templates whose transforms are in memory at a time, a few MB each [tuned]


@dataclass(frozen=True)
class Template:
    """Ground as descriptors (C, h, w) with mask (h, w) for one yaw and scale; its corner is at (e_min_m, n_max_m) from
    the point below the camera."""

    descriptors: np.ndarray
    mask: np.ndarray
    e_min_m: float
    n_max_m: float


@dataclass(frozen=True)
class Block:
    """Camera positions in cells [row, row + BLOCK_CELLS) x [column, column + BLOCK_CELLS). Cell (0, 0) has its corner
    at local (0, 0); rows increase southwards."""

    row: int
    column: int


@dataclass(frozen=True)
class BlockCorrelation:
    """``correlation`` and ``index`` (BLOCK_CELLS, BLOCK_CELLS): best value of each cell and the template that gave it;
    NaN and 0 where the map does not cover the ground."""

    correlation: np.ndarray
    index: np.ndarray


@dataclass(frozen=True)
class _Prepared:
    """``transform`` (C, H, W // 2 + 1): conjugate spectrum of the zero-mean template; ``energy``: its energy over
    ``count`` cells; ``corner`` and ``middle``: row and column of its corner and centre in the window of a block."""

    transform: np.ndarray
    count: float
    energy: float
    corner: tuple[int, int]
    centre: tuple[int, int]


def blocks_of(bounds_m: tuple[float, float, float, float], cell_m: float) -> list[Block]:
    """Blocks that cover the bounds (e_min, n_min, e_max, n_max), local metres."""
    e_min, n_min, e_max, n_max = bounds_m
    columns = range(int(np.floor(e_min / cell_m)), int(np.ceil(e_max / cell_m)), BLOCK_CELLS)
    rows = range(int(np.floor(-n_max / cell_m)), int(np.ceil(-n_min / cell_m)), BLOCK_CELLS)
    return [Block(r, c) for r, c in itertools.product(rows, columns)]


def select_blocks(
    places_m: Sequence[tuple[float, float]], blocks: Sequence[Block], cell_m: float, count: int
) -> list[Block]:
    """The first ``count`` of ``blocks`` that contain one of the camera positions (local east, north), in the order of
    these."""
    chosen: list[Block] = []
    for e_m, n_m in places_m:
        row, column = math.floor(-n_m / cell_m), math.floor(e_m / cell_m)
        inside = (b for b in blocks if 0 <= row - b.row < BLOCK_CELLS and 0 <= column - b.column < BLOCK_CELLS)
        if (block := next(inside, None)) is not None and block not in chosen:
            chosen.append(block)
            if len(chosen) == count:
                break
    return chosen


class BlockCorrelator:
    def __init__(self, source: MapWindows, describer: Describer) -> None:
        self._describer = describer
        self._features = CoarseDescriptors(source, describer)
        self.stride = describer.stride  # pixels per side of a cell

    def cell_m(self, wanted_m: float) -> float:
        """Cell size near the wanted one for which the package has stored descriptors; the wanted one if there is
        none."""
        return self._features.gsd_m(wanted_m / self.stride) * self.stride

    def describe(self, frame: Rectified) -> Template:
        h, w = (side // self.stride for side in frame.mask.shape)
        mask = np.asarray(frame.mask.reshape(h, self.stride, w, self.stride).all(axis=(1, 3)))
        return Template(self._describer.describe(frame.image), mask, frame.e_min_m, frame.n_max_m)

    def correlate(
        self, templates: Sequence[Template], blocks: Sequence[Block], cell_m: float
    ) -> list[BlockCorrelation]:
        """One result per block. All templates must be rectified with ``stride`` pixels per cell of ``cell_m``."""
        # Extent of each template relative to the camera's cell when the camera is in the first cell of a block.
        corners = [(round(-t.n_max_m / cell_m), round(t.e_min_m / cell_m)) for t in templates]
        ends = [(r + t.mask.shape[0], c + t.mask.shape[1]) for t, (r, c) in zip(templates, corners, strict=True)]
        low_r, low_c = (min(corner[axis] for corner in corners) for axis in (0, 1))
        height, width = (BLOCK_CELLS + max(end[k] for end in ends) - low for k, low in ((0, low_r), (1, low_c)))
        fft = transform_shape(height, width)
        results = [_empty_result() for _ in blocks]
        for begin in range(0, len(templates), CHUNK_TEMPLATES):
            chunk = range(begin, min(begin + CHUNK_TEMPLATES, len(templates)))
            prepared = [_prepare(templates[i], (corners[i][0] - low_r, corners[i][1] - low_c), fft) for i in chunk]
            for result, block in zip(results, blocks, strict=True):
                e_min_m, n_max_m = (block.column + low_c) * cell_m, -(block.row + low_r) * cell_m
                descriptors, valid, _, _ = self._features.window(e_min_m, n_max_m, width, height, cell_m / self.stride)
                if not valid.any():
                    continue
                spectrum = spectra(descriptors, fft)
                local_sums = _box_sums(descriptors, valid, prepared[0].count)
                for i, template in zip(chunk, prepared, strict=True):
                    product = cross_correlation(spectrum, template.transform)
                    correlation = _normalised(product, template, local_sums)
                    better = correlation > result.correlation
                    np.copyto(result.correlation, correlation, where=better)
                    np.copyto(result.index, np.uint8(i), where=better)
        for result in results:
            result.correlation[np.isneginf(result.correlation)] = np.nan
        return results


def _empty_result() -> BlockCorrelation:
    side = (BLOCK_CELLS, BLOCK_CELLS)
    return BlockCorrelation(np.full(side, -np.inf, np.float32), np.zeros(side, np.uint8))


def _prepare(template: Template, corner: tuple[int, int], fft: tuple[int, int]) -> _Prepared:
    weight = template.mask.astype(np.float32)
    count = float(weight.sum())
    mean = (template.descriptors * weight).sum((1, 2)) / count
    centred = (template.descriptors - mean[:, None, None]) * weight
    centre = tuple(round(float(v.mean())) for v in np.nonzero(template.mask))
    return _Prepared(
        template_spectra(centred, fft),
        count,
        float((centred**2).sum()),
        corner,
        (corner[0] + centre[0], corner[1] + centre[1]),
    )


def _normalised(product: np.ndarray, template: _Prepared, local_sums: tuple[np.ndarray, ...]) -> np.ndarray:
    """Zero-mean normalised correlation of each camera position of the block. ``local_sums``: result of ``_box_sums``,
    read at the centre of the template. -inf where the map does not cover the ground."""
    (r, c), (rm, cm) = template.corner, template.centre
    centre = (slice(rm, rm + BLOCK_CELLS), slice(cm, cm + BLOCK_CELLS))
    energy, squares, known = (sums[centre] for sums in local_sums)
    variance = np.maximum((energy - squares) * template.count, FLAT_VARIANCE * template.energy)
    correlation = product[r : r + BLOCK_CELLS, c : c + BLOCK_CELLS] / np.sqrt(
        np.maximum(variance * template.energy, 1e-12)
    )
    correlation[known < MIN_OVERLAP] = -np.inf
    return np.asarray(correlation)


def _box_sums(descriptors: np.ndarray, valid: np.ndarray, count: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means over a square of ``count`` cells around each cell: energy, sum of squared channel means, valid share."""
    side = max(round(float(np.sqrt(count))), 1) | 1
    box = (side, side)
    energy = cv2.boxFilter(np.einsum("khw,khw->hw", descriptors, descriptors), -1, box, borderType=cv2.BORDER_CONSTANT)
    squares = np.zeros_like(energy)
    for channel in descriptors:
        squares += cv2.boxFilter(channel, -1, box, borderType=cv2.BORDER_CONSTANT) ** 2
    ok = cv2.boxFilter(valid.astype(np.float32), -1, box, borderType=cv2.BORDER_CONSTANT)
    return energy, squares, ok
