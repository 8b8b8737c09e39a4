"""Pixel grid and extent of a mosaic."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer

from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.imagery import Bounds, Imagery

SLIVER_PX = 0.01
RESOLUTION_TOLERANCE = 1.05  # no resampling when the requested resolution is within this factor of the source's


@dataclass(frozen=True)
class Grid:
    """North-up pixels in a projected CRS (an authority's code or WKT)."""

    crs: str
    x_min: float
    y_max: float
    pixel_x: float
    pixel_y: float
    width_px: int
    height_px: int

    @property
    def bounds(self) -> Bounds:
        x_max, y_min = self.x_min + self.width_px * self.pixel_x, self.y_max - self.height_px * self.pixel_y
        return self.x_min, y_min, x_max, self.y_max


def grid_for(area: Area, sources: Sequence[Imagery], gsd_m: float | None) -> Grid:
    """The grid of the first source, so that its pixels are copied without resampling, limited to the part of the area
    that the sources cover.

    A requested resolution that is coarser than the source enlarges the pixels; a finer one has no effect.
    Raises MapError: no source reaches into the area."""
    first = sources[0]
    x_min, y_min, x_max, y_max = _within(Placed(area, first.crs).bounds, [_bounds_in(first.crs, s) for s in sources])
    if x_min >= x_max or y_min >= y_max:
        raise MapError(f"{area.name}: no source covers a part of this area; check their positions")
    factor = max(1.0, gsd_m / first.gsd_m) if gsd_m else 1.0
    if factor < RESOLUTION_TOLERANCE:
        factor = 1.0
    pixel_x, pixel_y = first.pixel_x * factor, first.pixel_y * factor
    left, right = _whole_pixels((x_min - first.x_min) / pixel_x, (x_max - first.x_min) / pixel_x)
    top, bottom = _whole_pixels((first.y_max - y_max) / pixel_y, (first.y_max - y_min) / pixel_y)
    authority = first.crs.to_authority(min_confidence=100)
    return Grid(
        crs=":".join(authority) if authority else first.crs.to_wkt(),
        x_min=first.x_min + left * pixel_x,
        y_max=first.y_max - top * pixel_y,
        pixel_x=pixel_x,
        pixel_y=pixel_y,
        width_px=right - left,
        height_px=bottom - top,
    )


def _whole_pixels(low: float, high: float) -> tuple[int, int]:
    """First and last edge of the whole pixels in between; slivers from rounding are ignored."""
    return math.floor(low + SLIVER_PX), math.ceil(high - SLIVER_PX)


def _bounds_in(crs: CRS, source: Imagery) -> Bounds:
    if source.crs == crs:
        return source.bounds
    west, south, east, north = Transformer.from_crs(source.crs, crs, always_xy=True).transform_bounds(*source.bounds)
    return float(west), float(south), float(east), float(north)


def _within(area: Bounds, sources: Sequence[Bounds]) -> Bounds:
    """Intersection of the area's box with the box around the sources that meet it."""
    met = [s for s in sources if s[0] < area[2] and s[2] > area[0] and s[1] < area[3] and s[3] > area[1]]
    if not met:
        return 0.0, 0.0, 0.0, 0.0
    low, high = np.min(met, axis=0), np.max(met, axis=0)
    return (
        max(area[0], float(low[0])),
        max(area[1], float(low[1])),
        min(area[2], float(high[2])),
        min(area[3], float(high[3])),
    )
