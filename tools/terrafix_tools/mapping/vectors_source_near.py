"""Which features of a large extract lie in the area of a map."""

import math

import numpy as np
from pyproj import CRS
from rasterio.transform import Affine

from terrafix_tools.mapping.area import Area, Placed
from terrafix_tools.mapping.vectors_source_rings import Ring, holds

GRID_PX = 512  # side of the raster on which a feature is looked up in the area
MOST_STEPS = 200_000


class Nearby:
    """Whether something lies in an area, to a five hundredth of its size and never too strict."""

    def __init__(self, area: Area) -> None:
        self._west, south, east, self._north = area.bounds_deg
        self._step_x, self._step_y = (east - self._west) / GRID_PX, (self._north - south) / GRID_PX
        grid = Affine(self._step_x, 0, self._west, 0, -self._step_y, self._north)
        self._point = float(area.rings[0][0][0]), float(area.rings[0][0][1])  # a lake may hold the whole area
        self._inside = Placed(area, CRS.from_epsg(4326)).burn(grid, GRID_PX, GRID_PX, touched=True)

    def has(self, points: Ring, *, surface: bool = False) -> bool:
        """Whether a line, or with ``surface`` what it goes around, shares a cell with the area."""
        if self._holds(*points[0]):  # nearly every feature of an extract that was cut to the area, thirty times as fast
            return True
        lon_lat = np.asarray(points, float)
        steps = np.abs(np.diff(lon_lat, axis=0)) / (self._step_x, self._step_y)
        at = np.concatenate([[0.0], np.cumsum(np.ceil(steps.max(axis=1)).clip(1.0))])
        if at[-1] > MOST_STEPS:  # an outline of continental size: nearer than a cell is not asked
            at = np.arange(len(lon_lat), dtype=float)
        every = np.arange(at[-1] + 1.0)
        columns = np.floor((np.interp(every, at, lon_lat[:, 0]) - self._west) / self._step_x).astype(int)
        rows = np.floor((self._north - np.interp(every, at, lon_lat[:, 1])) / self._step_y).astype(int)
        on = (columns >= 0) & (columns < GRID_PX) & (rows >= 0) & (rows < GRID_PX)
        return bool(self._inside[rows[on], columns[on]].any()) or (surface and holds(points, self._point))

    def _holds(self, lon_deg: float, lat_deg: float) -> bool:
        column = math.floor((lon_deg - self._west) / self._step_x)
        row = math.floor((self._north - lat_deg) / self._step_y)
        return 0 <= column < GRID_PX and 0 <= row < GRID_PX and bool(self._inside[row, column])

    def meets(self, west: float, south: float, east: float, north: float) -> bool:
        """Whether a box of degrees shares a cell with the area."""
        columns = np.floor((np.array([west, east]) - self._west) / self._step_x).clip(0, GRID_PX).astype(int)
        rows = np.floor((self._north - np.array([north, south])) / self._step_y).clip(0, GRID_PX).astype(int)
        return bool(self._inside[rows[0] : rows[1] + 1, columns[0] : columns[1] + 1].any())
