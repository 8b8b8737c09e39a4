"""The area of a map: a union of polygons in WGS84, and the pixels of a grid that lie in it."""

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Geod, Transformer
from rasterio.features import rasterize
from rasterio.transform import Affine

from terrafix.core.errors import MapError

EARTH = Geod(ellps="WGS84")
STEP_DEG = 0.02  # maximum edge length, about 2 km, so that an edge is straight in every projection
SIZE_GRID_PX = 1500  # side of the raster that measures the size of a union; accurate to about 0.3 %


@dataclass(frozen=True, eq=False)
class Area:
    """``rings``: each (n, 2) longitude and latitude in degrees, not closed; the area is their union without holes.
    ``notes``: what of its file was assumed or left out, a line each."""

    name: str
    rings: tuple[np.ndarray, ...]
    notes: tuple[str, ...] = ()

    @property
    def bounds_deg(self) -> tuple[float, float, float, float]:
        """West, south, east, north."""
        low = np.min([ring.min(axis=0) for ring in self.rings], axis=0)
        high = np.max([ring.max(axis=0) for ring in self.rings], axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def size_km2(self) -> float:
        """Size of the union on the ellipsoid, by counting cells."""
        west, south, east, north = self.bounds_deg
        step_x, step_y = (east - west) / SIZE_GRID_PX, (north - south) / SIZE_GRID_PX
        grid = Affine(step_x, 0, west, 0, -step_y, north)
        inside = Placed(self, CRS.from_epsg(4326)).burn(grid, SIZE_GRID_PX, SIZE_GRID_PX)
        lat_deg = north - (np.arange(SIZE_GRID_PX) + 0.5) * step_y
        return float((inside.sum(axis=1) * cell_km2(lat_deg, step_x, step_y)).sum())


class Placed:
    """An area in one CRS. Raises MapError outside the domain of the CRS."""

    def __init__(self, area: Area, crs: CRS) -> None:
        change = Transformer.from_crs(4326, crs, always_xy=True)
        self._rings = [np.stack(change.transform(*densify(ring).T), axis=1) for ring in area.rings]
        if not all(np.isfinite(ring).all() for ring in self._rings):
            raise MapError(f"{area.name}: lies outside the coordinate system '{crs.name}' of the imagery")
        self._low = np.array([ring.min(axis=0) for ring in self._rings])
        self._high = np.array([ring.max(axis=0) for ring in self._rings])

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max in the CRS."""
        low, high = self._low.min(axis=0), self._high.max(axis=0)
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def burn(self, transform: Affine, width: int, height: int, *, touched: bool = False) -> np.ndarray:
        """(height, width) bool of a north-up grid: pixel centre in the area, or any part of it with ``touched``."""
        left, top = transform.c, transform.f
        right, bottom = left + transform.a * width, top + transform.e * height
        near = (self._low <= (right, top)).all(axis=1) & (self._high >= (left, bottom)).all(axis=1)
        shapes = [polygon(self._rings[i]) for i in np.flatnonzero(near)]
        if not shapes:
            return np.zeros((height, width), bool)
        burnt = rasterize(shapes, (height, width), transform=transform, all_touched=touched, dtype="uint8")
        return burnt > 0


def polygon(ring: np.ndarray) -> dict[str, object]:
    """GeoJSON geometry."""
    return {"type": "Polygon", "coordinates": [[*ring.tolist(), ring[0].tolist()]]}


def densify(ring: np.ndarray) -> np.ndarray:
    """Densifies a closed ring (n, 2) degrees -> (m, 2), so that no edge is longer than STEP_DEG."""
    return cut_edges(ring, np.roll(ring, -1, axis=0))


def cut_edges(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Start points (m, 2) of the parts of edges a[i] to b[i], each at most STEP_DEG long."""
    pieces = []
    for start, end in zip(a, b, strict=True):
        count = max(1, math.ceil(float(np.abs(end - start).max()) / STEP_DEG))
        pieces.append(start + (end - start) * (np.arange(count) / count)[:, None])
    return np.concatenate(pieces)


def cell_km2(lat_deg: np.ndarray, step_lon_deg: float, step_lat_deg: float) -> np.ndarray:
    """Cell size at these latitudes: radii of curvature of the ellipsoid (Snyder, USGS PP 1395, 4-18 and 4-20)."""
    lat = np.radians(lat_deg)
    e2 = EARTH.es
    w = np.sqrt(1.0 - e2 * np.sin(lat) ** 2)
    along_m = EARTH.a * (1.0 - e2) / w**3 * math.radians(step_lat_deg)
    across_m = EARTH.a / w * np.cos(lat) * math.radians(step_lon_deg)
    return along_m * across_m / 1e6
