"""Tests whether features of a large extract lie in the area of a map."""

import math

import numpy as np
from pyproj import CRS
from rasterio.transform import Affine

from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.vectors.rings import Ring, contains

GRID_PX = 512  # side of the raster of the area
MAX_STEPS = 200_000


class AreaFilter:
    """Intersection test with an area, accurate to a five hundredth of its size, with errors towards True only."""

    def __init__(self, area: Area) -> None:
        self._west, south, east, self._north = area.bounds_deg
        self._step_x, self._step_y = (east - self._west) / GRID_PX, (self._north - south) / GRID_PX
        grid = Affine(self._step_x, 0, self._west, 0, -self._step_y, self._north)
        self._point = float(area.rings[0][0][0]), float(area.rings[0][0][1])  # a lake may contain the whole area
        self._inside = Placed(area, CRS.from_epsg(4326)).burn(grid, GRID_PX, GRID_PX, touched=True)

    def has(self, points: Ring, *, surface: bool = False) -> bool:
        """True when a line, or with ``surface`` its interior, shares a cell with the area."""
        if self._contains(*points[0]):  # fast path, thirty times as fast: most features of a cropped extract
            return True
        lon_lat = np.asarray(points, float)
        steps = np.abs(np.diff(lon_lat, axis=0)) / (self._step_x, self._step_y)
        at = np.concatenate([[0.0], np.cumsum(np.ceil(steps.max(axis=1)).clip(1.0))])
        if at[-1] > MAX_STEPS:  # an outline of continental size is not sampled at cell resolution
            at = np.arange(len(lon_lat), dtype=float)
        every = np.arange(at[-1] + 1.0)
        columns = np.floor((np.interp(every, at, lon_lat[:, 0]) - self._west) / self._step_x).astype(int)
        rows = np.floor((self._north - np.interp(every, at, lon_lat[:, 1])) / self._step_y).astype(int)
        on = (columns >= 0) & (columns < GRID_PX) & (rows >= 0) & (rows < GRID_PX)
        return bool(self._inside[rows[on], columns[on]].any()) or (surface and contains(points, self._point))

    def _contains(self, lon_deg: float, lat_deg: float) -> bool:
        column = math.floor((lon_deg - self._west) / self._step_x)
        row = math.floor((self._north - lat_deg) / self._step_y)
        return 0 <= column < GRID_PX and 0 <= row < GRID_PX and bool(self._inside[row, column])

    def meets(self, west: float, south: float, east: float, north: float) -> bool:
        """True when a box in degrees shares a cell with the area."""
        columns = np.floor((np.array([west, east]) - self._west) / self._step_x).clip(0, GRID_PX).astype(int)
        rows = np.floor((self._north - np.array([north, south])) / self._step_y).clip(0, GRID_PX).astype(int)
        return bool(self._inside[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1].any())
