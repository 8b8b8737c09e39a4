"""What all imagery of a map is: north-up pixels in one projected CRS."""

import math
from types import TracebackType
from typing import Self

import numpy as np
from pyproj import CRS, Geod, Transformer

from terrafix.map.format import InputStatement

Bounds = tuple[float, float, float, float]  # x_min, y_min, x_max, y_max in the CRS


class Imagery:
    """Pixel (r, c) covers [x_min + c pixel_x, y_max - r pixel_y). ``has_mask`` False: there is no validity mask; a
    black or white collar is searched. A context manager."""

    crs: CRS
    width_px: int
    height_px: int
    pixel_x: float
    pixel_y: float
    x_min: float
    y_max: float
    has_mask: bool = True

    @property
    def statements(self) -> tuple[InputStatement, ...]:
        """What its files were taken for."""
        return ()

    @property
    def bounds(self) -> Bounds:
        x_max, y_min = self.x_min + self.width_px * self.pixel_x, self.y_max - self.height_px * self.pixel_y
        return self.x_min, y_min, x_max, self.y_max

    @property
    def gsd_m(self) -> float:
        """Ground metres per pixel at the centre, on the ellipsoid; EPSG:3857 pixels are smaller than nominal."""
        x_min, y_min, x_max, y_max = self.bounds
        return ground_pixel_m(self.crs, (x_min + x_max) / 2, (y_min + y_max) / 2, self.pixel_x, self.pixel_y)

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """A window inside the image: (height, width, 3) uint8 BGR and mask (height, width) uint8 of 0 and 255."""
        raise NotImplementedError

    def close(self) -> None:
        """Closes its files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def ground_pixel_m(crs: CRS, x: float, y: float, pixel_x: float, pixel_y: float) -> float:
    """Geometric mean of a pixel's sides on the ground, metres, at (x, y) of the CRS."""
    across_m = ground_distance_m(crs, (x - 50 * pixel_x, y), (x + 50 * pixel_x, y)) / 100
    down_m = ground_distance_m(crs, (x, y - 50 * pixel_y), (x, y + 50 * pixel_y)) / 100
    return math.sqrt(across_m * down_m)


def ground_distance_m(crs: CRS, a: tuple[float, float], b: tuple[float, float]) -> float:
    lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform([a[0], b[0]], [a[1], b[1]])
    return float(Geod(ellps="WGS84").inv(lon_deg[0], lat_deg[0], lon_deg[1], lat_deg[1])[2])
