"""One imagery layer seen in the metres of a local frame: windows at any scale."""

import math

import cv2
import numpy as np
from pyproj import CRS, Transformer

from terrafix.anchor.map_format import TILE_PX, Layer, Level
from terrafix.anchor.map_tiles import TileStore

COARSER_ALLOWED = 1.1  # a level up to 10 % coarser than asked is used rather than one almost twice as fine
BLOCK_PX = 512  # a window is rendered in blocks that stay in the cache, each with an affine map of its own
MIN_BLOCK_PX = 64
AFFINE_TOLERANCE_PX = 0.02  # split a block until its affine map is this close to the projection, in pixels of the level
BLUR_MIN_SCALE = 1.17  # below this reduction the bilinear kernel is filter enough


class LayerView:
    def __init__(self, layer: Layer, tiles: TileStore, local: CRS) -> None:
        self._layer = layer
        self._tiles = tiles
        self._to_crs = Transformer.from_crs(local, layer.crs, always_xy=True)
        to_local = Transformer.from_crs(layer.crs, local, always_xy=True)
        self.bounds_m: tuple[float, float, float, float] = to_local.transform_bounds(*layer.bounds, densify_pts=51)
        # Ground size of one CRS unit at the centre of the layer, to choose a level in metres.
        self._unit_m = layer.gsd_m / math.sqrt(layer.levels[-1].pixel_x * layer.levels[-1].pixel_y)

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """As ``LocalMap.window``."""
        image = np.zeros((height_px, width_px, 3), np.uint8)
        mask = np.zeros((height_px, width_px), np.uint8)
        level = self._level_for(gsd_m)
        for row in range(0, height_px, BLOCK_PX):
            for column in range(0, width_px, BLOCK_PX):
                part = (slice(row, min(row + BLOCK_PX, height_px)), slice(column, min(column + BLOCK_PX, width_px)))
                self._render(image[part], mask[part], e_min_m + column * gsd_m, n_max_m - row * gsd_m, gsd_m, level)
        return image, mask.view(bool)

    def _level_for(self, gsd_m: float) -> Level:
        """The coarsest level that still has the detail asked for."""
        for level in self._layer.levels:
            if math.sqrt(level.pixel_x * level.pixel_y) * self._unit_m <= gsd_m * COARSER_ALLOWED:
                return level
        return self._layer.levels[-1]

    def _render(
        self, image: np.ndarray, mask: np.ndarray, e_min_m: float, n_max_m: float, gsd_m: float, level: Level
    ) -> None:
        """Fills one block (views into the window), splitting it until an affine map is exact enough."""
        height_px, width_px = mask.shape
        knots = np.array([0.0, 0.5, 1.0])
        c, r = (a.ravel() for a in np.meshgrid(knots * width_px - 0.5, knots * height_px - 0.5))
        x, y = self._to_crs.transform(e_min_m + (c + 0.5) * gsd_m, n_max_m - (r + 0.5) * gsd_m)
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            return
        # Pixel coordinates of the level, with integers at pixel centres as OpenCV has it.
        u = (x - self._layer.x_min) / level.pixel_x - 0.5
        v = (self._layer.y_max - y) / level.pixel_y - 0.5
        design = np.stack([c, r, np.ones_like(c)], axis=1)
        uv = np.stack([u, v], axis=1)
        affine = np.linalg.lstsq(design, uv, rcond=None)[0]  # (3, 2)
        error_px = float(np.abs(design @ affine - uv).max())
        if error_px > AFFINE_TOLERANCE_PX and max(width_px, height_px) > MIN_BLOCK_PX:
            for rows in _halves(height_px):
                for columns in _halves(width_px):
                    e_m, n_m = e_min_m + columns.start * gsd_m, n_max_m - rows.start * gsd_m
                    self._render(image[rows, columns], mask[rows, columns], e_m, n_m, gsd_m, level)
            return
        scale = math.sqrt(abs(np.linalg.det(affine[:2])))
        sigma_px = 0.5 * math.sqrt(scale * scale - 1.0) if scale > BLUR_MIN_SCALE else 0.0
        margin = 2 + math.ceil(3 * sigma_px)
        low = np.floor(uv.min(axis=0)).astype(int) - margin
        high = np.ceil(uv.max(axis=0)).astype(int) + margin + 1
        start, end = np.maximum(low, 0), np.minimum(high, [level.columns * TILE_PX, level.rows * TILE_PX])
        if (start >= end).any():
            return
        (u_0, v_0), (width, height) = (int(v) for v in start), (int(v) for v in end - start)
        source, source_mask = self._tiles.mosaic(self._layer.table, level, u_0, v_0, width, height)
        if source_mask is None and ((start != low).any() or (end != high).any()):
            source_mask = np.full(source.shape[:2], 255, np.uint8)  # the window reaches beyond the tiles
        if source_mask is not None and not source_mask.any():
            return
        if sigma_px > 0:
            side = 2 * max(1, round(2.5 * sigma_px)) + 1
            source = cv2.GaussianBlur(source, (side, side), sigma_px)
            if source_mask is not None:
                source_mask = cv2.erode(source_mask, np.ones((side, side), np.uint8))
        matrix = affine.T - np.array([[0.0, 0.0, u_0], [0.0, 0.0, v_0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        # Four channels: OpenCV warps them in half the time of three, and the fourth carries the mask.
        four = cv2.cvtColor(source, cv2.COLOR_BGR2BGRA)
        if source_mask is not None:
            cv2.insertChannel(source_mask, four, 3)
        warped = cv2.warpAffine(four, matrix, (width_px, height_px), flags=flags)
        cv2.cvtColor(warped, cv2.COLOR_BGRA2BGR, dst=image)
        if source_mask is None:
            mask[:] = 1
            return
        mask[:] = warped[:, :, 3] == 255  # every pixel that was blended is valid
        image[mask == 0] = 0


def _halves(size: int) -> list[slice]:
    """One slice, or two when the block is large enough to split."""
    half = size // 2
    return [slice(0, size)] if size <= MIN_BLOCK_PX else [slice(0, half), slice(half, size)]
