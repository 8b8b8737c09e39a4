"""Elevation for a map package: a raster of metres AMSL, resampled to the map's CRS in tiles."""

import math
import zlib
from collections.abc import Callable
from pathlib import Path
from types import TracebackType

import numpy as np
from pyproj import CRS, Transformer
from rasterio.enums import Resampling
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from terrafix.anchor.map_format import DEM_TILE_PX, DemGrid
from terrafix.core.errors import MapError
from terrafix_tools.mapping.gpkg import GpkgWriter
from terrafix_tools.mapping.source import SAMPLE_PX, crs_of, ground_distance_m, ground_pixel_m, open_raster

PLAUSIBLE_M = (-500.0, 9000.0)  # the shore of the Dead Sea is at -430 m, Everest at 8849 m; the rest is void
FINEST_M = 1.0  # finer elevation than this adds megabytes, not accuracy
OVERSAMPLING = 2  # bilinear twice on one grid rounds off ridges: 0.7 m rms on 90 m posts in mountains, 0.2 m this way
MARGIN_M = 500.0  # beyond the imagery: an oblique ray may meet the ground outside it
ZLIB_LEVEL = 6


class DemSource:
    """Elevation on a square north-up grid in the map's CRS. A context manager."""

    def __init__(self, path: Path, crs: CRS, bounds: tuple[float, float, float, float]) -> None:
        self.path = path
        self._file = open_raster(path)
        dem_crs = crs_of(self._file, path)
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
        self._columns = math.ceil(self.grid.width_px / DEM_TILE_PX)
        self._rows = math.ceil(self.grid.height_px / DEM_TILE_PX)
        self.tile_count = self._columns * self._rows
        self._data = WarpedVRT(
            self._file,
            src_crs=dem_crs.to_wkt(),
            crs=crs.to_wkt(),
            transform=Affine(pixel, 0, self.grid.x_min, 0, -pixel, self.grid.y_max),
            width=self._columns * DEM_TILE_PX + 1,
            height=self._rows * DEM_TILE_PX + 1,
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

    def write(self, writer: GpkgWriter, on_tile: Callable[[], None]) -> None:
        """All tiles that know something, row by row. Raises MapError when none does."""
        written = 0
        for row in range(self._rows):
            for column in range(self._columns):
                window = Window(column * DEM_TILE_PX, row * DEM_TILE_PX, DEM_TILE_PX + 1, DEM_TILE_PX + 1)
                height_m = self._data.read(1, window=window)
                plausible = (height_m >= PLAUSIBLE_M[0]) & (height_m <= PLAUSIBLE_M[1])
                height_m = np.where(plausible, height_m, np.float32(np.nan))
                on_tile()
                if plausible.any():
                    writer.add_tile(-1, column, row, zlib.compress(height_m.astype("<f4").tobytes(), ZLIB_LEVEL))
                    written += 1
        if not written:
            raise MapError(f"{self.path}: no elevation under the imagery; give a DEM that covers it")

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
        """The declared void, or an implausible value that the file uses for it without saying so (-9999, -32768)."""
        if self._file.nodata is not None:
            return float(self._file.nodata)
        shrink = max(1.0, max(self._file.width, self._file.height) / SAMPLE_PX)
        shape = (max(1, int(self._file.height / shrink)), max(1, int(self._file.width / shrink)))
        sample = self._file.read(1, out_shape=shape)
        wrong = sample[np.isfinite(sample) & ((sample < PLAUSIBLE_M[0]) | (sample > PLAUSIBLE_M[1]))]
        if wrong.size == 0:
            return None
        values, counts = np.unique(wrong, return_counts=True)
        return float(values[np.argmax(counts)])
