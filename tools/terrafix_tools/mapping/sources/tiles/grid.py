"""Web Mercator tiles (EPSG:3857, the "Google Maps compatible" matrix set of OGC 17-083r4): indices and positions."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pyproj import CRS
from rasterio.transform import Affine

from terrafix_tools.mapping.area.polygons import Placed

MERCATOR = CRS.from_epsg(3857)
EARTH_RADIUS_M = 6_378_137.0  # of the sphere of EPSG:3857
HALF_M = math.pi * EARTH_RADIUS_M  # the extent of the projection is -HALF_M to HALF_M
MAX_ZOOM = 23  # 2 cm per pixel


class Tile(NamedTuple):
    """Row 0 is in the north, as in XYZ; TMS and MBTiles count from the south."""

    zoom: int
    column: int
    row: int


@dataclass(frozen=True)
class TileRange:
    """Tiles of one zoom around an area, and a mask of those that touch it."""

    zoom: int
    column: int  # of the first tile
    row: int
    touched: np.ndarray  # (rows, columns) bool

    @property
    def count(self) -> int:
        return int(self.touched.sum())

    def __iter__(self) -> Iterator[Tile]:
        """Row by row from the north."""
        for row, line in enumerate(self.touched):
            for column in np.flatnonzero(line):
                yield Tile(self.zoom, self.column + int(column), self.row + row)


def tile_span_m(zoom: int) -> float:
    """Side of a tile in units of EPSG:3857."""
    return 2.0 * HALF_M / (1 << zoom)


def ground_pixel_m(zoom: int, lat_deg: float, tile_px: int) -> float:
    """Ground metres per pixel of a tile, on the sphere (within 0.7 % of the ellipsoid)."""
    return tile_span_m(zoom) / tile_px * math.cos(math.radians(lat_deg))


def zoom_for(gsd_m: float, lat_deg: float, tile_px: int) -> int:
    """The coarsest zoom whose pixels are not larger than ``gsd_m`` (with a tolerance of a hundredth)."""
    exact = math.log2(2.0 * HALF_M * math.cos(math.radians(lat_deg)) / (tile_px * gsd_m * 1.01))
    return min(max(math.ceil(exact), 0), MAX_ZOOM)


def tiles_of(placed: Placed, zoom: int) -> TileRange:
    """All tiles that touch an area in EPSG:3857."""
    span_m = tile_span_m(zoom)
    last = (1 << zoom) - 1
    x_min, y_min, x_max, y_max = placed.bounds
    first_column = min(max(math.floor((x_min + HALF_M) / span_m), 0), last)
    last_column = min(max(math.floor((x_max + HALF_M) / span_m), 0), last)
    first_row = min(max(math.floor((HALF_M - y_max) / span_m), 0), last)
    last_row = min(max(math.floor((HALF_M - y_min) / span_m), 0), last)
    transform = Affine(span_m, 0, first_column * span_m - HALF_M, 0, -span_m, HALF_M - first_row * span_m)
    width, height = last_column - first_column + 1, last_row - first_row + 1
    return TileRange(zoom, first_column, first_row, placed.burn(transform, width, height, touched=True))
