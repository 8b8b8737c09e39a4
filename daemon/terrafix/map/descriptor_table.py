"""Precomputed tile descriptors of a map package, resampled to the coordinates of a local frame."""

import math

import cv2
import numpy as np
from pyproj import Transformer

from terrafix.map.format import TILE_PX, DescriptorTable, Layer, Level
from terrafix.map.imagery import FIT_AFFINE, KNOTS
from terrafix.map.tile_cache import TileStore


class StoredDescriptors:
    """Reads windows of the descriptors of one layer."""

    def __init__(
        self, layer: Layer, table: DescriptorTable, tiles: TileStore, to_crs: Transformer, unit_m: float
    ) -> None:
        """``to_crs``: local frame -> CRS of the layer; ``unit_m``: ground metres per unit of that CRS."""
        self._layer, self._table, self._tiles, self._to_crs = layer, table, tiles, to_crs
        self._levels = {
            math.sqrt(level.pixel_x * level.pixel_y) * unit_m: level
            for level in layer.levels
            if level.zoom in table.zooms
        }

    @property
    def gsds_m(self) -> tuple[float, ...]:
        """Ground sampling distance in metres of each level that has descriptors (pixels, not cells)."""
        return tuple(self._levels)

    def window(
        self, e_min_m: float, n_max_m: float, width: int, height: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray, float, float]:
        """Same contract as ``MapFeatures.window``. ``gsd_m`` is one of ``gsds_m``; a cell has ``pool`` pixels a side.

        -> descriptors (channels, height, width) float32, valid (height, width) bool, east and north in metres of the
        north-west corner. North up; ``width`` and ``height`` count cells."""
        level, pool = self._levels[gsd_m], self._table.pool
        cell_m = gsd_m * pool
        column, row = round(e_min_m / cell_m), round(-n_max_m / cell_m)
        corner = np.array([column * cell_m, -row * cell_m])
        knots = corner + KNOTS[:, :2] * (width * cell_m, -height * cell_m)
        x, y = self._to_crs.transform(knots[:, 0], knots[:, 1])
        u = (np.asarray(x) - self._layer.x_min) / (level.pixel_x * pool) - 0.5
        v = (self._layer.y_max - np.asarray(y)) / (level.pixel_y * pool) - 0.5
        out = np.zeros((self._table.channels, height, width), np.float32)
        valid = np.zeros((height, width), bool)
        if not np.isfinite(u + v).all():  # outside the domain of the projection
            return out, valid, float(corner[0]), float(corner[1])
        uv = np.stack([u, v], axis=1)
        affine = FIT_AFFINE @ uv
        across, down = affine[0] / width, affine[1] / height
        low = np.floor(uv.min(axis=0)).astype(int) - 1
        high = np.ceil(uv.max(axis=0)).astype(int) + 2
        planes = self._mosaic(level, (int(low[0]), int(low[1])), (int(high[0] - low[0]), int(high[1] - low[1])))
        start = affine[2] + (across + down) / 2 - low
        matrix = np.stack([across, down, start], axis=1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for k in range(self._table.channels):
            cv2.warpAffine(planes[k], matrix, (width, height), out[k], flags=flags)
        np.equal(cv2.warpAffine(planes[-1], matrix, (width, height), flags=flags), 255.0, out=valid)
        out *= valid / 255.0
        return _rotate_orientations(out, math.atan2(across[1], across[0])), valid, float(corner[0]), float(corner[1])

    def _mosaic(self, level: Level, corner: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
        """Cells [corner, corner + size), column first -> (channels + 1, height, width) float32, 0 to 255.

        The last plane is the validity mask. Missing tiles are zero."""
        (column, row), (width, height), side = corner, size, TILE_PX // self._table.pool
        out = np.zeros((self._table.channels + 1, height, width), np.float32)
        for tr in range(max(row // side, 0), min((row + height - 1) // side, level.rows - 1) + 1):
            for tc in range(max(column // side, 0), min((column + width - 1) // side, level.columns - 1) + 1):
                tile = self._tiles.tile((self._table.table, level.zoom, tc, tr))
                if tile is None:
                    continue
                r, c = tr * side - row, tc * side - column
                rows, columns = slice(max(r, 0), min(r + side, height)), slice(max(c, 0), min(c + side, width))
                planes = tile[0].reshape(-1, side, side)
                out[:, rows, columns] = planes[:, rows.start - r : rows.stop - r, columns.start - c : columns.stop - c]
        return out


def _rotate_orientations(descriptors: np.ndarray, angle_rad: float) -> np.ndarray:
    """Rotates gradient orientations from the axes of the layer to those of the local frame.

    ``angle_rad``: from the layer's columns to east, clockwise (rows go down). Channels are orientations modulo pi,
    clockwise; a rotation by a fraction of a channel is interpolated linearly."""
    steps = -angle_rad / (math.pi / len(descriptors))
    whole_steps = math.floor(steps)
    fraction = np.float32(steps - whole_steps)
    return (1 - fraction) * np.roll(descriptors, whole_steps, axis=0) + fraction * np.roll(
        descriptors, whole_steps + 1, axis=0
    )
