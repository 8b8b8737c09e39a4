"""A small generated place: one plan, two looks of it (map and camera), a DEM, all georeferenced.

For the demo and for tests that must run without data. Nothing here is real; the seed decides everything."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import rasterio
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from terrafix.core.errors import OutputError
from terrafix_tools.sim.world_layout import DEM_MARGIN_M, DEM_POST_M, Layout, plan
from terrafix_tools.sim.world_paint import paint
from terrafix_tools.sim.world_season import SEASONS

WIDTH_M, HEIGHT_M = 3000.0, 2000.0
GSD_M = 0.5
EPSG = 32633  # UTM 33 north
WEST_M, NORTH_M = (
    451_000.0,
    5_334_000.0,
)  # upper left corner, UTM; west of the central meridian: grid north is not north
JPEG_QUALITY = 90  # of the map's tiles: invisible, and a tenth of the size


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

    def look(self, season: str) -> np.ndarray:
        """The place in "summer" or "autumn": (H, W, 3) uint8 BGR."""
        return paint(self.layout, SEASONS[season], self.gsd_m, self.seed)


def generate(seed: int, *, width_m: float = WIDTH_M, height_m: float = HEIGHT_M, gsd_m: float = GSD_M) -> World:
    """The place that belongs to ``seed``. The plan does not depend on ``gsd_m``."""
    return World(seed, plan(np.random.default_rng([seed, 0]), width_m, height_m), gsd_m)


def write_image(path: Path, world: World, image_bgr: np.ndarray) -> None:
    """Georeferenced RGB GeoTIFF. Raises OutputError."""
    height, width = image_bgr.shape[:2]
    profile = {"driver": "GTiff", "width": width, "height": height, "count": 3, "dtype": "uint8", "tiled": True}
    profile |= {"compress": "JPEG", "jpeg_quality": JPEG_QUALITY, "photometric": "YCBCR"}
    rgb = np.moveaxis(cv2.cvtColor(image_bgr, cv2.COLOR_BGR2RGB), 2, 0)
    _write(path, profile | {"transform": world.utm_from_px}, rgb)


def write_dem(path: Path, world: World) -> None:
    """Georeferenced elevation GeoTIFF, metres AMSL. Raises OutputError."""
    height, width = world.dem_amsl_m.shape
    profile = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": 1,
        "dtype": "float32",
        "compress": "deflate",
    }
    _write(path, profile | {"transform": world.utm_from_dem}, world.dem_amsl_m[None])


def _write(path: Path, profile: dict[str, object], bands: np.ndarray) -> None:
    try:
        with rasterio.open(path, "w", crs=f"EPSG:{EPSG}", **profile) as file:
            file.write(bands)
    except (rasterio.errors.RasterioIOError, OSError) as error:
        raise OutputError(f"{path}: cannot be written ({error}); choose another --out") from None
