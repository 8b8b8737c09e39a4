"""Ground of a simulated flight: an image over an elevation model in the local frame, of any size and origin."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.windows import Window

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.ground.relief import Relief
from terrafix_lab.sim.ground.tiles import TILE_PX, Make, Pyramid, blank, of_array, outside
from terrafix_lab.sim.ground.warp import Warp, fit
from terrafix_tools.mapping.datum import crs_of
from terrafix_tools.mapping.package.dem import PLAUSIBLE_M
from terrafix_tools.mapping.package.height_values import check_amsl, heights_of
from terrafix_tools.mapping.source import ImagerySource, open_raster

MAX_POSTS = 4096  # of a side; a finer elevation model is averaged down to 64 MB
DEM_MARGIN_M = 2000.0  # beyond the image: hills there do not occlude it but appear in oblique views
SEA_LEVEL = np.zeros((2, 2), np.float32)


@dataclass(frozen=True)
class Ground:
    """Everything that a camera can see. Immutable except for the tile cache."""

    picture: Pyramid
    px_from_local: Warp  # of level 0
    relief: Relief

    def height_amsl_m(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        """Returns the ground height at local points (any shape), bilinear; beyond the DEM its edge value."""
        return self.relief.height_amsl_m(e_m, n_m)


def drape(
    image_bgr: np.ndarray,
    crs_from_px: Affine,
    dem_amsl_m: np.ndarray,
    crs_from_dem: Affine,
    crs: CRS,
    frame: LocalFrame,
) -> Ground:
    """Creates the ground from rasters in memory: (H, W, 3) uint8 and (h, w) in one projected CRS. Raises MapError: not
    near ``frame``.
    """
    relief = Relief(dem_amsl_m, fit(crs_from_dem, dem_amsl_m.shape, crs, frame))
    return Ground(Pyramid(of_array(image_bgr)), fit(crs_from_px, image_bgr.shape[:2], crs, frame), relief)


def open_ground(image: Path, dem: Path | None, frame: LocalFrame) -> Ground:
    """Opens a georeferenced image (any CRS, bands and depth that GDAL reads) over an elevation model, metres AMSL.

    Without ``dem`` the ground is flat at 0 m. Where the image has no data, the ground has its mean colour. The files
    stay open while the ground is used. Raises MapError: not readable, no georeference, not near ``frame``.
    """
    source = ImagerySource(image)
    warp = fit(source.transform, (source.height_px, source.width_px), source.crs, frame, str(image))
    if dem is None:
        flat = fit(_scaled(source.transform, source.width_px, source.height_px), (1, 1), source.crs, frame)
        return Ground(Pyramid(of_file(source)), warp, Relief(SEA_LEVEL, flat))
    return Ground(Pyramid(of_file(source)), warp, _read_relief(dem, source, frame))


def of_file(source: ImagerySource) -> Make:
    """Returns the tiles of an image file, read on demand."""
    colour = _mean_colour(source)

    def make(level: int, i: int, j: int) -> np.ndarray | None:
        if outside(level, i, j, source.width_px, source.height_px):
            return blank(colour)
        if level > 0:
            return None
        tile = blank(colour).copy()
        width, height = min(TILE_PX, source.width_px - i * TILE_PX), min(TILE_PX, source.height_px - j * TILE_PX)
        image, mask = source.read(i * TILE_PX, j * TILE_PX, width, height)
        np.copyto(tile[:height, :width], image, where=mask[..., None] > 0)
        return tile

    return make


def _mean_colour(source: ImagerySource) -> np.ndarray:
    """Mean colour (3,) uint8 of a few windows across the image."""
    sums, count = np.zeros(3), 0
    side = min(256, source.width_px, source.height_px)
    for share in (0.15, 0.5, 0.85):
        x, y = int(share * (source.width_px - side)), int(share * (source.height_px - side))
        image, mask = source.read(x, y, side, side)
        sums += image[mask > 0].sum(axis=0, dtype=np.float64)
        count += int(np.count_nonzero(mask))
    return np.round(sums / max(count, 1)).astype(np.uint8)


def _read_relief(path: Path, source: ImagerySource, frame: LocalFrame) -> Relief:
    """Reads the part of an elevation file under and around the image. Raises MapError."""
    with open_raster(path) as file:
        crs = crs_of(file, path)
        heights = heights_of(file, str(path))
        check_amsl(heights, path)
        window = _dem_window(file, crs, source)
        if window is None:
            raise MapError(f"{path}: no elevation under {source.path}; give a DEM that covers it")
        decimation = max(1.0, window.width / MAX_POSTS, window.height / MAX_POSTS)
        shape = (max(2, int(window.height / decimation)), max(2, int(window.width / decimation)))
        try:
            band = file.read(1, window=window, out_shape=shape, resampling=Resampling.average, masked=True)
        except RasterioError as error:
            raise MapError(f"{path}: cannot be read ({error})") from None
        amsl_m = (
            band.filled(np.nan).astype(np.float32) if band.dtype.kind == "f" else band.astype(np.float32).filled(np.nan)
        )
        amsl_m = heights.to_m(amsl_m)
        a = file.transform
    west, north = a.a * window.col_off + a.b * window.row_off + a.c, a.d * window.col_off + a.e * window.row_off + a.f
    corner = Affine(a.a, a.b, west, a.d, a.e, north)
    crs_from_post = _scaled(corner, window.width / shape[1], window.height / shape[0])
    valid = (amsl_m >= PLAUSIBLE_M[0]) & (amsl_m <= PLAUSIBLE_M[1])
    if not valid.any():
        raise MapError(f"{path}: no elevation under {source.path}; give a DEM that covers it")
    return Relief(_fill_voids(amsl_m, valid), fit(crs_from_post, shape, crs, frame, str(path)))


def _dem_window(file: Any, crs: CRS, source: ImagerySource) -> Window | None:
    """Returns the window of an elevation file under the image with DEM_MARGIN_M around it; None without overlap."""
    x_min, y_min, x_max, y_max = source.bounds
    margin = DEM_MARGIN_M * source.pixel_x / source.gsd_m
    edge = np.linspace(0.0, 1.0, 21)
    x = x_min - margin + (x_max - x_min + 2 * margin) * np.concatenate([edge, edge, 0 * edge, 0 * edge + 1])
    y = y_min - margin + (y_max - y_min + 2 * margin) * np.concatenate([0 * edge, 0 * edge + 1, edge, edge])
    x, y = Transformer.from_crs(source.crs, crs, always_xy=True).transform(x, y)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return None
    back = ~file.transform
    columns, rows = back.a * x + back.b * y + back.c, back.d * x + back.e * y + back.f
    left, right = max(0, int(columns.min()) - 1), min(file.width, int(columns.max()) + 2)
    top, bottom = max(0, int(rows.min()) - 1), min(file.height, int(rows.max()) + 2)
    return Window(left, top, right - left, bottom - top) if right - left >= 2 and bottom - top >= 2 else None


def _fill_voids(amsl_m: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Fills voids with the height of the nearest valid post."""
    if valid.all():
        return amsl_m
    void = (~valid).astype(np.uint8)
    labels = cv2.distanceTransformWithLabels(void, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    height_of = np.zeros(int(labels.max()) + 1, np.float32)
    height_of[labels[valid]] = amsl_m[valid]
    return np.where(valid, amsl_m, height_of[labels])


def _scaled(affine: Affine, across: float, down: float) -> Affine:
    """Returns the affine of pixels larger by these factors. (Affine's own product is `*` in old versions and `@` in
    new ones.)
    """
    return Affine(affine.a * across, affine.b * down, affine.c, affine.d * across, affine.e * down, affine.f)
