"""A generated place of any size: one plan, rendered in several seasons, with a DEM, georeferenced.

The place is a function of the seed and has no real counterpart. It is a part of an unbounded country that is rendered
on demand, so that its size needs no memory.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.transform import Affine
from rasterio.windows import Window

from terrafix.core.errors import OutputError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.ground.draped_image import Ground
from terrafix_lab.sim.ground.relief import Relief
from terrafix_lab.sim.ground.tiles import TILE_PX, Pyramid
from terrafix_lab.sim.ground.warp import fit
from terrafix_lab.sim.world.layout import DEM_MARGIN_M, DEM_POST_M, Layout, plan
from terrafix_lab.sim.world.paint import Painter
from terrafix_lab.sim.world.season import SEASONS

WIDTH_M, HEIGHT_M = 3000.0, 2000.0
GSD_M = 0.5
EPSG = 32633  # UTM 33 north
WEST_M, NORTH_M = (
    451_000.0,
    5_334_000.0,
)  # upper left corner, UTM; west of the central meridian, so that grid north differs from true north
MIN_SIDE_M, MAX_AREA_KM2 = 100.0, 100.0
PIECE_PX = 2048  # a whole season is rendered in parts of this size; a multiple of the blocks of a GeoTIFF
COARSE_LEVEL = 3  # pyramid level that is rendered at its own resolution instead of by downsampling
JPEG_QUALITY = 90  # of the map's tiles: no visible loss at a tenth of the size


@dataclass(frozen=True)
class World:
    seed: int
    layout: Layout
    gsd_m: float

    @property
    def dem_amsl_m(self) -> np.ndarray:
        """(h, w) float32, posts every DEM_POST_M."""
        return self.layout.dem_amsl_m

    @property
    def utm_from_px(self) -> Affine:
        """Corner of image pixel (column, row) -> UTM (e, n)."""
        return Affine(self.gsd_m, 0.0, WEST_M, 0.0, -self.gsd_m, NORTH_M)

    @property
    def utm_from_dem(self) -> Affine:
        """Corner of DEM cell (column, row) -> UTM (e, n); the posts are the centres of the cells."""
        west, north = WEST_M - DEM_MARGIN_M - DEM_POST_M / 2, NORTH_M + DEM_MARGIN_M + DEM_POST_M / 2
        return Affine(DEM_POST_M, 0.0, west, 0.0, -DEM_POST_M, north)

    def wgs84(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Plan metres (east, south of the upper left corner) -> (lat_deg, lon_deg)."""
        back = Transformer.from_crs(CRS.from_epsg(EPSG), CRS.from_epsg(4326), always_xy=True)
        lon_deg, lat_deg = back.transform(WEST_M + x_m, NORTH_M - y_m)
        return float(lat_deg), float(lon_deg)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return round(self.layout.height_m / self.gsd_m), round(self.layout.width_m / self.gsd_m)

    def render(self, season: str) -> np.ndarray:
        """Renders the whole place in a season (a key of SEASONS) in memory, 12 MB a km2: (H, W, 3) uint8 BGR."""
        image = np.empty((*self.shape, 3), np.uint8)
        for rows, columns, part in self._pieces(season):
            image[rows, columns] = part
        return image

    def ground(self, season: str, frame: LocalFrame) -> Ground:
        """Returns the ground in a season for a camera, rendered on demand; it continues beyond the place's edges."""
        crs = CRS.from_epsg(EPSG)
        fine, coarse = (
            Painter(self.layout, SEASONS[season], gsd_m) for gsd_m in (self.gsd_m, self.gsd_m * 2**COARSE_LEVEL)
        )

        def make(level: int, i: int, j: int) -> np.ndarray | None:
            if level not in (0, COARSE_LEVEL):
                return None
            return (fine if level == 0 else coarse).paint(i * TILE_PX, j * TILE_PX, TILE_PX, TILE_PX)

        relief = Relief(self.dem_amsl_m, fit(self.utm_from_dem, self.dem_amsl_m.shape, crs, frame))
        return Ground(Pyramid(make), fit(self.utm_from_px, self.shape, crs, frame), relief)

    def write_rendering(self, path: Path, season: str) -> None:
        """Writes the place in a season as a georeferenced RGB GeoTIFF, part by part. Raises OutputError."""
        with _image_file(path, self, self.shape) as file:
            for rows, columns, part in self._pieces(season):
                file.write(_rgb(part), window=Window.from_slices(rows, columns))

    def _pieces(self, season: str) -> Iterator[tuple[slice, slice, np.ndarray]]:
        painter = Painter(self.layout, SEASONS[season], self.gsd_m)
        height, width = self.shape
        for y in range(0, height, PIECE_PX):
            for x in range(0, width, PIECE_PX):
                rows, columns = slice(y, min(y + PIECE_PX, height)), slice(x, min(x + PIECE_PX, width))
                yield rows, columns, painter.paint(x, y, columns.stop - x, rows.stop - y)


def generate(seed: int, *, width_m: float = WIDTH_M, height_m: float = HEIGHT_M, gsd_m: float = GSD_M) -> World:
    """Returns the place of ``seed``. The plan is independent of ``gsd_m`` and of the size, which only sets the extent.

    Raises UsageError when it is too small or larger than MAX_AREA_KM2.
    """
    if not (width_m >= MIN_SIDE_M and height_m >= MIN_SIDE_M and width_m * height_m <= MAX_AREA_KM2 * 1e6):
        raise UsageError(
            f"a world of {width_m:g} x {height_m:g} m: choose at least {MIN_SIDE_M:g} m a side and at most "
            f"{MAX_AREA_KM2:g} km2"
        )
    return World(seed, plan(seed, width_m, height_m), gsd_m)


def write_image(path: Path, world: World, image_bgr: np.ndarray) -> None:
    """Writes a rendered image as a georeferenced RGB GeoTIFF. Raises OutputError."""
    with _image_file(path, world, image_bgr.shape[:2]) as file:
        file.write(_rgb(image_bgr))


def write_dem(path: Path, world: World) -> None:
    """Writes the DEM as a georeferenced GeoTIFF, metres AMSL. Raises OutputError."""
    height, width = world.dem_amsl_m.shape
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 1, "dtype": "float32"}
    with _file(path, profile | {"compress": "deflate", "transform": world.utm_from_dem}) as file:
        file.write(world.dem_amsl_m[None])


def _rgb(image_bgr: np.ndarray) -> np.ndarray:
    return np.moveaxis(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB), 2, 0)


def _image_file(path: Path, world: World, shape: tuple[int, ...]) -> AbstractContextManager[Any]:
    profile = {"driver": "GTiff", "width": shape[1], "height": shape[0], "count": 3, "dtype": "uint8", "tiled": True}
    profile |= {"compress": "JPEG", "jpeg_quality": JPEG_QUALITY, "photometric": "YCBCR"}
    return _file(path, profile | {"transform": world.utm_from_px})


@contextmanager
def _file(path: Path, profile: dict[str, object]) -> Iterator[Any]:
    try:
        with rasterio.open(path, "w", crs=f"EPSG:{EPSG}", **profile) as file:
            yield file
    except (rasterio.errors.RasterioIOError, OSError) as error:
        raise OutputError(f"{path}: cannot be written ({error}); choose another --out") from None
