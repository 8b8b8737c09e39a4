"""Elevation for a map package: a raster of heights AMSL, resampled to the map's CRS in 16-bit tiles of metres."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

import cv2
import msgspec
import numpy as np
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.errors import RasterioError
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from terrafix.core.errors import MapError
from terrafix.map.format import DEM_NULL, DEM_TILE_PX, DemGrid, Level
from terrafix_tools.mapping.choices import Datum, Unit
from terrafix_tools.mapping.datum import crs_of
from terrafix_tools.mapping.imagery import Bounds, ground_distance_m, ground_pixel_m
from terrafix_tools.mapping.layers import Elevation, ElevationInput
from terrafix_tools.mapping.package.gpkg import GpkgWriter
from terrafix_tools.mapping.package.height_values import check_amsl, height_statement, heights_of
from terrafix_tools.mapping.package.pyramid import Place
from terrafix_tools.mapping.source import SAMPLE_PX, holds, open_raster

PLAUSIBLE_M = (-500.0, 9000.0)  # the Dead Sea's shore is at -430 m, Everest at 8849 m; other values are voids
FINEST_M = 1.0  # a finer grid adds megabytes without accuracy
OVERSAMPLING = 2  # bilinear resampling twice flattens ridges: 0.7 m rms on 90 m posts in mountains, 0.2 m with this
MARGIN_M = 500.0  # beyond the imagery: an oblique ray may hit the ground outside it
STEP_M = 0.01  # resolution of stored heights; coarser in a tile with a height range above 655 m
PNG_LEVEL = 6
TILES_PER_WORKER = (
    300  # ten milliseconds each: fewer tiles do not compensate the two seconds that a process needs to start
)


class DemSource:
    """Elevation on a square north-up grid in the map's CRS, from any GDAL raster. A context manager.

    ``unit``, ``datum``: as the user states them. Raises MapError: not a raster, not georeferenced, not near the map, of
    unknown unit, or counted from the ellipsoid and not stated to be otherwise."""

    def __init__(
        self, path: Path, crs: CRS, bounds: Bounds, *, unit: Unit | None = None, datum: Datum | None = None
    ) -> None:
        self.path = path
        self._file = open_raster(path)
        if self._file.count >= 3:  # a second band may be alpha
            raise MapError(f"{path}: has {self._file.count} bands, elevation has one; give a DEM")
        dem_crs = crs_of(self._file, path)
        self.heights = heights_of(self._file, str(path), unit, datum)
        if datum is None:
            check_amsl(self.heights, path)
        x_min, y_min, x_max, y_max = bounds
        x_mid, y_mid = (x_min + x_max) / 2, (y_min + y_max) / 2
        unit_m = ground_pixel_m(crs, x_mid, y_mid, 1.0, 1.0)
        pixel_m = max(self._native_pixel_m(crs, dem_crs, x_mid, y_mid) / OVERSAMPLING, FINEST_M)
        pixel = pixel_m / unit_m
        margin = math.ceil(MARGIN_M / unit_m / pixel) * pixel
        self.grid = DemGrid(
            x_min=x_min - margin,
            y_max=y_max + margin,
            pixel=pixel,
            width_px=math.ceil((x_max - x_min + 2 * margin) / pixel) + 1,
            height_px=math.ceil((y_max - y_min + 2 * margin) / pixel) + 1,
        )
        centre = self._file.transform @ (self._file.width / 2, self._file.height / 2)
        self.statement = height_statement(self._file, path, self.heights, dem_crs, centre)
        level = level_of(self.grid)
        self._data = WarpedVRT(
            self._file,
            src_crs=dem_crs.to_wkt(),
            crs=crs.to_wkt(),
            transform=Affine(pixel, 0, self.grid.x_min, 0, -pixel, self.grid.y_max),
            width=level.columns * DEM_TILE_PX,
            height=level.rows * DEM_TILE_PX,
            resampling=Resampling.bilinear,
            src_nodata=self._void_value(),
            nodata=math.nan,
            dtype="float32",
        )

    def __enter__(self) -> "DemSource":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._data.close()
        self._file.close()

    def read_tile(self, column: int, row: int) -> np.ndarray:
        """Same contract as ``Elevation``. Raises MapError: the file is damaged."""
        window = Window(column * DEM_TILE_PX, row * DEM_TILE_PX, DEM_TILE_PX, DEM_TILE_PX)
        try:
            return self.heights.to_m(self._data.read(1, window=window))
        except RasterioError as error:
            raise self._unreadable(error) from None

    def _unreadable(self, error: RasterioError) -> MapError:
        return MapError(f"{self.path}: elevation cannot be read ({error}); check or download the file again")

    def _native_pixel_m(self, crs: CRS, dem_crs: CRS, x: float, y: float) -> float:
        """Finer side of the DEM's pixel on the ground, metres, near (x, y) of the map's CRS."""
        x, y = Transformer.from_crs(crs, dem_crs, always_xy=True).transform(x, y)
        if not (math.isfinite(x) and math.isfinite(y)):
            raise MapError(f"{self.path}: no elevation under the imagery; give a DEM that covers it")
        a = self._file.transform
        return min(
            ground_distance_m(dem_crs, (x, y), (x + a.a, y + a.d)),
            ground_distance_m(dem_crs, (x, y), (x + a.b, y + a.e)),
        )

    def _void_value(self) -> float | None:
        """The nodata value, declared or not: an implausible value that the file uses (-9999, -32768)."""
        if self._file.nodata is not None and holds(self._file.dtypes[0], self._file.nodata):
            return float(self._file.nodata)
        shrink = max(1.0, max(self._file.width, self._file.height) / SAMPLE_PX)
        shape = (max(1, int(self._file.height / shrink)), max(1, int(self._file.width / shrink)))
        try:
            sample = self._file.read(1, out_shape=shape)
        except RasterioError as error:
            raise self._unreadable(error) from None
        height_m = self.heights.to_m(sample)
        wrong = sample[np.isfinite(sample) & ((height_m < PLAUSIBLE_M[0]) | (height_m > PLAUSIBLE_M[1]))]
        if wrong.size == 0:
            return None
        values, counts = np.unique(wrong, return_counts=True)
        return float(values[np.argmax(counts)])


def level_of(grid: DemGrid) -> Level:
    """The single tile matrix of an elevation grid."""
    return Level(
        0, grid.pixel, grid.pixel, math.ceil(grid.width_px / DEM_TILE_PX), math.ceil(grid.height_px / DEM_TILE_PX)
    )


@dataclass(frozen=True)
class HeightTile:
    """A stored tile; ``statistics``: min, max, mean, standard deviation in metres."""

    data: bytes
    scale: float
    offset: float
    statistics: tuple[float, float, float, float]


@dataclass(frozen=True)
class HeightRenderer:
    """Renders tiles from open elevation, in a worker process. ``open_heights`` creates one from picklable arguments."""

    elevation: Elevation

    def render(self, place: Place) -> HeightTile | None:
        """One tile; None when all of it is void."""
        height_m = self.elevation.read_tile(*place)
        plausible = (height_m >= PLAUSIBLE_M[0]) & (height_m <= PLAUSIBLE_M[1])  # False for NaN
        if not plausible.any():
            return None
        known = height_m[plausible].astype(np.float64)
        statistics = (float(known.min()), float(known.max()), float(known.mean()), float(known.std()))
        return HeightTile(*encode_heights(height_m, plausible), statistics)


def open_heights(open_elevation: Callable[[CRS, Bounds], Elevation], crs: CRS, bounds: Bounds) -> HeightRenderer:
    """Opens the elevation for the lifetime of the process."""
    return HeightRenderer(open_elevation(crs, bounds).__enter__())


def height_places(grid: DemGrid) -> list[Place]:
    """Column and row of all tiles, row by row."""
    level = level_of(grid)
    return [(column, row) for row in range(level.rows) for column in range(level.columns)]


def write_elevation(
    writer: GpkgWriter, given: ElevationInput, template: DemGrid, crs: CRS, tiles: Iterable[HeightTile | None]
) -> DemGrid:
    """Writes ``tiles``, in the order of ``height_places``; returns the grid for the manifest.

    Raises MapError when all tiles are void."""
    grid = msgspec.structs.replace(template, source=given.source, licence=given.licence)
    writer.add_elevation_table(grid, crs, level_of(grid), STEP_M)
    written = 0
    for (column, row), tile in zip(height_places(grid), tiles, strict=True):
        if tile is not None:
            writer.add_elevation_tile(column, row, tile.data, tile.scale, tile.offset, tile.statistics)
            written += 1
    if not written:
        raise MapError(f"{given.source}: no elevation under the imagery; give a DEM that covers it")
    return grid


def encode_heights(height_m: np.ndarray, known: np.ndarray) -> tuple[bytes, float, float]:
    """16-bit PNG, and scale and offset to metres; void where not ``known``."""
    low, high = float(height_m[known].min()), float(height_m[known].max())
    scale = max(STEP_M, (high - low) / (DEM_NULL - 1))
    steps = np.rint((np.where(known, height_m, low).astype(np.float64) - low) / scale)
    coded = np.where(known, steps, DEM_NULL).astype(np.uint16)
    return cv2.imencode(".png", coded, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1].tobytes(), scale, low
