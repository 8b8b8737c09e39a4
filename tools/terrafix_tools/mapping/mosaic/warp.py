"""One source on the grid of a mosaic: copied where the grids agree, else resampled (after averaging if it is finer)."""

import cv2
import numpy as np
from pyproj import CRS, Transformer

from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.mosaic.grid import Grid

AGREE_PX = 0.01  # grids whose pixels differ by less than this are the same
NODE_PX = 32  # spacing of exact projections; interpolation between them is linear, with an error far below a pixel
MARGIN_PX = 2
MAX_SOURCE_PX = 4096 * 4096  # source pixels in memory at a time


Window = tuple[np.ndarray, np.ndarray] | None  # (h, w, 3) BGR and (h, w) mask; None: outside the source


class Warped:
    def __init__(self, source: Imagery, grid: Grid, crs: CRS) -> None:
        self._source, self._grid = source, grid
        self._change = None if source.crs == crs else Transformer.from_crs(crs, source.crs, always_xy=True)
        self._shift: tuple[int, int] | None = None if self._change else self._whole_shift()

    def read(self, column: int, row: int, width: int, height: int) -> Window:
        """A window of the mosaic's grid."""
        if self._shift is not None:
            return self._copy(column + self._shift[0], row + self._shift[1], width, height)
        return self._resample(column, row, width, height)

    def _whole_shift(self) -> tuple[int, int] | None:
        """Columns and rows from the mosaic's corner to the source's; None when their rasters differ."""
        source, grid = self._source, self._grid
        if abs(source.pixel_x / grid.pixel_x - 1.0) * grid.width_px > AGREE_PX:
            return None
        if abs(source.pixel_y / grid.pixel_y - 1.0) * grid.height_px > AGREE_PX:
            return None
        columns = (grid.x_min - source.x_min) / source.pixel_x
        rows = (source.y_max - grid.y_max) / source.pixel_y
        if max(abs(columns - round(columns)), abs(rows - round(rows))) > AGREE_PX:
            return None
        return round(columns), round(rows)

    def _copy(self, column: int, row: int, width: int, height: int) -> Window:
        x0, y0 = max(column, 0), max(row, 0)
        x1, y1 = min(column + width, self._source.width_px), min(row + height, self._source.height_px)
        if x1 <= x0 or y1 <= y0:
            return None
        pixels, valid = self._source.read(x0, y0, x1 - x0, y1 - y0)
        image = np.zeros((height, width, 3), np.uint8)
        mask = np.zeros((height, width), np.uint8)
        inner = slice(y0 - row, y1 - row), slice(x0 - column, x1 - column)
        image[inner], mask[inner] = pixels, valid
        return image, mask

    def _resample(self, column: int, row: int, width: int, height: int) -> Window:
        u, v = self._source_pixels(column, row, width, height)
        x0, y0 = int(max(np.floor(u.min()) - MARGIN_PX, 0)), int(max(np.floor(v.min()) - MARGIN_PX, 0))
        x1 = int(min(np.ceil(u.max()) + MARGIN_PX + 1, self._source.width_px))
        y1 = int(min(np.ceil(v.max()) + MARGIN_PX + 1, self._source.height_px))
        if x1 <= x0 or y1 <= y0:
            return None
        if (x1 - x0) * (y1 - y0) > MAX_SOURCE_PX and max(width, height) > NODE_PX:
            return self._in_quarters(column, row, width, height)
        pixels, valid = self._source.read(x0, y0, x1 - x0, y1 - y0)
        if not valid.any():
            return None
        # A source that is finer than the grid is averaged first, because bilinear sampling alone would alias.
        step = max((u[0, -1] - u[0, 0]) / max(width - 1, 1), (v[-1, 0] - v[0, 0]) / max(height - 1, 1))
        shrink = max(int(step), 1)
        if shrink > 1:
            size = (max((x1 - x0) // shrink, 1), max((y1 - y0) // shrink, 1))
            pixels, valid = (
                pixels[: size[1] * shrink, : size[0] * shrink],
                valid[: size[1] * shrink, : size[0] * shrink],
            )
            pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
            valid = np.where(cv2.resize(valid, size, interpolation=cv2.INTER_AREA) == 255, 255, 0).astype(np.uint8)
        u = ((u - x0 + 0.5) / shrink - 0.5).astype(np.float32)
        v = ((v - y0 + 0.5) / shrink - 0.5).astype(np.float32)
        image = cv2.remap(pixels, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        whole = cv2.remap(valid, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        # All interpolated pixels must be valid; half a source pixel is lost at the edge.
        return image, np.where(whole >= 254, 255, 0).astype(np.uint8)

    def _in_quarters(self, column: int, row: int, width: int, height: int) -> Window:
        image = np.zeros((height, width, 3), np.uint8)
        mask = np.zeros((height, width), np.uint8)
        half_w, half_h = max(width // 2, 1), max(height // 2, 1)
        for top, bottom in ((0, half_h), (half_h, height)):
            for left, right in ((0, half_w), (half_w, width)):
                if right > left and bottom > top:
                    part = self._resample(column + left, row + top, right - left, bottom - top)
                    if part is not None:
                        image[top:bottom, left:right], mask[top:bottom, left:right] = part
        return image, mask

    def _source_pixels(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """Source column and row (integers at pixel centres) of every pixel's centre: two (height, width) float64."""
        grid, source = self._grid, self._source
        columns = np.linspace(0, width - 1, max(2, -(-width // NODE_PX) + 1))
        rows = np.linspace(0, height - 1, max(2, -(-height // NODE_PX) + 1))
        x = np.broadcast_to(grid.x_min + (column + columns + 0.5) * grid.pixel_x, (len(rows), len(columns)))
        y = np.broadcast_to((grid.y_max - (row + rows + 0.5) * grid.pixel_y)[:, None], (len(rows), len(columns)))
        if self._change is not None:
            x, y = self._change.transform(x, y)
        u = (x - source.x_min) / source.pixel_x - 0.5
        v = (source.y_max - y) / source.pixel_y - 0.5
        return spread(u, columns, rows, width, height), spread(v, columns, rows, width, height)


def spread(nodes: np.ndarray, columns: np.ndarray, rows: np.ndarray, width: int, height: int) -> np.ndarray:
    """Bilinear interpolation from nodes at (rows, columns) to every pixel."""
    wide = np.stack([np.interp(np.arange(width), columns, line) for line in nodes])
    at = np.interp(np.arange(height), rows, np.arange(len(rows)))
    low = np.minimum(at.astype(int), max(len(rows) - 2, 0))
    share = (at - low)[:, None]
    return wide[low] * (1.0 - share) + wide[np.minimum(low + 1, len(rows) - 1)] * share
