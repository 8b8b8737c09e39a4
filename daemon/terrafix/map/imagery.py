"""One imagery layer, resampled to windows in local frame coordinates at any scale."""

import math
from typing import NamedTuple

import cv2
import numpy as np
from pyproj import CRS

from terrafix.core.geodesy import transformer
from terrafix.map.format import TILE_PX, Layer, Level
from terrafix.map.tile_cache import TileStore

MAX_COARSER_RATIO = 1.1  # accept a level up to 10 % coarser than requested instead of one almost twice as fine
BLOCK_PX = 512  # a window is rendered in blocks that fit the CPU cache, each with its own affine map
MIN_BLOCK_PX = 64
AFFINE_TOLERANCE_PX = 0.02  # split a block until its affine map is within this of the projection, in level pixels
# Downsampling by s needs a low-pass of variance (s^2 - 1) / 4 px^2. The kernel [1 2 1] / 4 has variance 0.5 and costs a
# quarter of any other kernel: up to a factor of two, it is used or no filter is used, whichever variance is nearer.
BLUR_MIN_SCALE, BLUR_FAST_SCALE = math.sqrt(2.0), 2.0

# Corners, edge midpoints and centre of a block as (s, t, 1) with s and t from 0 to 1, and the pseudo-inverse that maps
# nine values there to their least-squares affine map.
KNOTS = np.array([(s, t, 1.0) for t in (0.0, 0.5, 1.0) for s in (0.0, 0.5, 1.0)])
FIT_AFFINE = np.linalg.pinv(KNOTS)


class ImageBlock(NamedTuple):
    """A part of a window: first row and column, height and width in pixels."""

    row: int
    column: int
    height: int
    width: int

    @property
    def slices(self) -> tuple[slice, slice]:
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    def quarters(self) -> list["ImageBlock"]:
        """Four parts; two when one side is too short to halve."""
        rows = _split_half(self.row, self.height)
        return [ImageBlock(r, c, h, w) for r, h in rows for c, w in _split_half(self.column, self.width)]


class LayerView:
    """A layer in the local frame with CRS ``local``."""

    def __init__(self, layer: Layer, tiles: TileStore, local: CRS) -> None:
        self._layer = layer
        self._tiles = tiles
        self.to_crs = transformer(local, layer.crs)
        self.bounds_m: tuple[float, float, float, float] = self.to_crs.transform_bounds(
            *layer.bounds, densify_pts=51, direction="INVERSE"
        )
        # Ground metres per CRS unit at the centre of the layer, to select a level by its resolution in metres.
        self.unit_m = layer.gsd_m / math.sqrt(layer.levels[-1].pixel_x * layer.levels[-1].pixel_y)

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Same contract as ``LocalMap.window``."""
        image = np.zeros((height_px, width_px, 3), np.uint8)
        mask = np.zeros((height_px, width_px), np.uint8)
        level = self._level_for(gsd_m)
        blocks = [
            ImageBlock(row, column, min(BLOCK_PX, height_px - row), min(BLOCK_PX, width_px - column))
            for row in range(0, height_px, BLOCK_PX)
            for column in range(0, width_px, BLOCK_PX)
        ]
        while blocks:
            uv = self._project(blocks, e_min_m, n_max_m, gsd_m, level)
            affine = FIT_AFFINE @ uv
            error_px = np.abs(KNOTS @ affine - uv).max(axis=(1, 2))  # NaN outside the projection domain: left empty
            to_split: list[ImageBlock] = []
            for i, block in enumerate(blocks):
                if error_px[i] > AFFINE_TOLERANCE_PX and max(block.height, block.width) > MIN_BLOCK_PX:
                    to_split += block.quarters()
                elif np.isfinite(uv[i]).all():
                    place = block.slices
                    self._render_block(image[place], mask[place], affine[i], uv[i], level)
            blocks = to_split
        return image, mask.view(bool)

    def _level_for(self, gsd_m: float) -> Level:
        """Coarsest level with at least the requested resolution; the finest level when none has it."""
        for level in self._layer.levels:
            if math.sqrt(level.pixel_x * level.pixel_y) * self.unit_m <= gsd_m * MAX_COARSER_RATIO:
                return level
        return self._layer.levels[-1]

    def _project(
        self, blocks: list[ImageBlock], e_min_m: float, n_max_m: float, gsd_m: float, level: Level
    ) -> np.ndarray:
        """(blocks, 9, 2): column and row in the level at the knots of each block; integers are pixel centres."""
        offsets = np.array([(b.column, b.row) for b in blocks])[:, None]
        sizes = np.array([(b.width, b.height) for b in blocks])[:, None]
        pixels = offsets + KNOTS[:, :2] * sizes
        x, y = self.to_crs.transform(e_min_m + pixels[..., 0] * gsd_m, n_max_m - pixels[..., 1] * gsd_m)
        u = (x - self._layer.x_min) / level.pixel_x - 0.5
        v = (self._layer.y_max - y) / level.pixel_y - 0.5
        return np.stack([u, v], axis=2)

    def _render_block(
        self, image: np.ndarray, mask: np.ndarray, affine: np.ndarray, uv: np.ndarray, level: Level
    ) -> None:
        """Renders one block (``image`` and ``mask`` are views into the window). ``affine`` (3, 2) maps (s, t, 1), both
        0 to 1 over the block, to column and row of the level; ``uv`` (9, 2) are the knots in the level."""
        height_px, width_px = mask.shape
        across, down = affine[0] / width_px, affine[1] / height_px
        scale = math.sqrt(abs(float(across[0] * down[1] - across[1] * down[0])))
        side, sigma_px = _low_pass(scale)
        margin = 2 + side // 2
        low = np.floor(uv.min(axis=0)).astype(int) - margin
        high = np.ceil(uv.max(axis=0)).astype(int) + margin + 1
        start, end = np.maximum(low, 0), np.minimum(high, [level.columns * TILE_PX, level.rows * TILE_PX])
        if (start >= end).any():
            return
        (u_0, v_0), (width, height) = (int(v) for v in start), (int(v) for v in end - start)
        source, all_valid = self._tiles.mosaic(self._layer.table, level, u_0, v_0, width, height)
        all_valid &= bool((start == low).all() and (end == high).all())  # False when the block exceeds the tile matrix
        if not all_valid and not source[:, :, 3].any():
            return
        if side > 1:
            valid = None if all_valid else cv2.erode(cv2.extractChannel(source, 3), np.ones((side, side), np.uint8))
            source = cv2.GaussianBlur(source, (side, side), sigma_px)
            if valid is not None:
                cv2.insertChannel(valid, source, 3)
        # OpenCV's convention: coordinates refer to pixel centres of the block.
        corner = affine[2] + (across + down) / 2 - (u_0, v_0)
        # OpenCV warps four channels in half the time of three; the fourth channel is the validity mask.
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        warped = cv2.warpAffine(source, np.stack([across, down, corner], axis=1), (width_px, height_px), flags=flags)
        cv2.cvtColor(warped, cv2.COLOR_BGRA2BGR, dst=image)
        if all_valid:
            mask[:] = 1
            return
        np.equal(cv2.extractChannel(warped, 3), 255, out=mask.view(bool))  # valid: all interpolated pixels are valid
        image[mask == 0] = 0


def _low_pass(scale: float) -> tuple[int, float]:
    """Side and sigma in pixels of the Gaussian kernel for a scale. Side 1: no filter; sigma 0: OpenCV's default."""
    if scale <= BLUR_FAST_SCALE:
        return (3, 0.0) if scale > BLUR_MIN_SCALE else (1, 0.0)
    sigma_px = 0.5 * math.sqrt(scale * scale - 1.0)
    return 2 * round(2.5 * sigma_px) + 1, sigma_px


def _split_half(start: int, size: int) -> list[tuple[int, int]]:
    """(start, size) split in two halves, or unsplit when it is too short."""
    half = size // 2
    return [(start, size)] if size <= MIN_BLOCK_PX else [(start, half), (start + half, size - half)]
