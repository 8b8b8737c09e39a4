"""Imagery for the map builder: any GDAL raster as north-up windows of 8-bit BGR with a mask."""

import math
import warnings
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import rasterio
from pyproj import CRS, Geod, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from terrafix.core.errors import MapError

SAMPLE_PX = 1024  # side of the downsampled image that determines the value range of deep pixels
STRETCH_PERCENT = (0.5, 99.5)  # percentiles of the sample; 16-bit and float pixels outside saturate


class ImagerySource:
    """North-up view of an image: pixel (r, c) covers [x_min + c px, y_max - r py) in `crs`. A context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = open_raster(path)
        self._data: Any = self._file
        crs = crs_of(self._file, path)
        transform: Affine = self._file.transform
        self.warped = not (transform.b == 0 and transform.d == 0 and transform.a > 0 and transform.e < 0)
        _check_place(self._file, crs, path)
        if crs.is_geographic:
            crs, self.warped = _utm_of(self._file, crs), True
        self.crs = crs
        self._colours = self._colour_table()
        if self.warped:
            self._data = self._north_up(crs)
        self.width_px, self.height_px = int(self._data.width), int(self._data.height)
        self.pixel_x, self.pixel_y = float(self._data.transform.a), -float(self._data.transform.e)
        self.x_min, self.y_max = float(self._data.transform.c), float(self._data.transform.f)
        self.bands = self._choose_bands()
        # A mask in the file (alpha, nodata, mask band) is used; without one a black collar is searched.
        flags = [f for band in self._file.mask_flag_enums for f in band]
        self.has_mask = self.warped or any(f.name != "all_valid" for f in flags)
        self._stretch = self._find_stretch()

    def __enter__(self) -> "ImagerySource":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._data is not self._file:
            self._data.close()
        self._file.close()

    @property
    def transform(self) -> Affine:
        return Affine(self.pixel_x, 0, self.x_min, 0, -self.pixel_y, self.y_max)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max in the CRS."""
        return (
            self.x_min,
            self.y_max - self.height_px * self.pixel_y,
            self.x_min + self.width_px * self.pixel_x,
            self.y_max,
        )

    @property
    def gsd_m(self) -> float:
        """Ground metres per pixel at the centre, on the ellipsoid; EPSG:3857 pixels are smaller than nominal."""
        x = self.x_min + 0.5 * self.width_px * self.pixel_x
        y = self.y_max - 0.5 * self.height_px * self.pixel_y
        return ground_pixel_m(self.crs, x, y, self.pixel_x, self.pixel_y)

    def read(self, column: int, row: int, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
        """A window inside the image: (height, width, 3) uint8 BGR and mask (height, width) uint8 of 0 and 255."""
        window = Window(column, row, width, height)
        try:
            bands, mask = self._read_bands(window)
        except RasterioError:
            raise MapError(
                f"{self.path}: cannot be read near column {column}, row {row}; check or download the file again"
            ) from None
        if np.issubdtype(bands.dtype, np.floating):
            mask = np.where(np.isfinite(bands).all(axis=0), mask, 0)
        picture = self._to_bytes(bands)
        image = cv2.merge([picture[-1], picture[len(picture) // 2], picture[0]])  # three bands or one; BGR
        return image, cv2.threshold(mask, 0, 255, cv2.THRESH_BINARY)[1]

    def _read_bands(self, window: Window) -> tuple[np.ndarray, np.ndarray]:
        """-> the chosen bands, (n, h, w), and the mask, (h, w) uint8, not zero where valid."""
        if self.warped:
            # One by one: each is then read from GDAL's cached blocks, which hold all bands of a reprojection. Asked for
            # several, GDAL reprojects the window once for each of them.
            bands = np.stack([self._data.read(band, window=window) for band in self.bands])
        else:
            bands = self._data.read(self.bands, window=window)
        if self.has_mask:
            return bands, self._data.dataset_mask(window=window)
        return bands, np.full(bands.shape[1:], 255, np.uint8)

    def _to_bytes(self, bands: np.ndarray) -> np.ndarray:
        if self._colours is not None:
            return self._colours[bands[0].astype(np.uint8)].transpose(2, 0, 1)
        if self._stretch is None:
            return bands.astype(np.uint8, copy=False)
        low, high = self._stretch
        scaled = (np.nan_to_num(bands.astype(np.float32), nan=low) - low) * (255.0 / (high - low))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)

    def _north_up(self, crs: CRS) -> Any:
        """The image resampled to a north-up grid of equal ground sampling."""
        source = self._file
        geo_crs = CRS.from_user_input(source.crs.to_wkt())
        a = source.transform
        half_columns, half_rows = source.width / 2, source.height / 2
        centre_x = a.a * half_columns + a.b * half_rows + a.c
        centre_y = a.d * half_columns + a.e * half_rows + a.f
        step_m = min(
            ground_distance_m(geo_crs, (centre_x, centre_y), (centre_x + a.a, centre_y + a.d)),
            ground_distance_m(geo_crs, (centre_x, centre_y), (centre_x + a.b, centre_y + a.e)),
        )
        change = Transformer.from_crs(geo_crs, crs, always_xy=True)
        edge = np.linspace(0.0, 1.0, 21)
        columns = np.concatenate([edge, edge, np.zeros(21), np.ones(21)]) * source.width
        rows = np.concatenate([np.zeros(21), np.ones(21), edge, edge]) * source.height
        x, y = change.transform(a.a * columns + a.b * rows + a.c, a.d * columns + a.e * rows + a.f)
        middle_x, middle_y = float(np.mean([x.min(), x.max()])), float(np.mean([y.min(), y.max()]))
        pixel = step_m / ground_pixel_m(crs, middle_x, middle_y, 1.0, 1.0)
        x_min = math.floor(float(x.min()) / pixel) * pixel
        y_max = math.ceil(float(y.max()) / pixel) * pixel
        return WarpedVRT(
            source,
            crs=crs.to_wkt(),
            transform=Affine(pixel, 0, x_min, 0, -pixel, y_max),
            width=math.ceil((float(x.max()) - x_min) / pixel),
            height=math.ceil((y_max - float(y.min())) / pixel),
            resampling=Resampling.nearest if self._colours is not None else Resampling.bilinear,
            add_alpha=ColorInterp.alpha not in source.colorinterp and source.nodata is None,
        )

    def _colour_table(self) -> np.ndarray | None:
        """(256, 3) RGB of a palette image."""
        if self._file.colorinterp[0] != ColorInterp.palette:
            return None
        table = np.zeros((256, 3), np.uint8)
        for index, colour in self._file.colormap(1).items():
            if index < 256:
                table[index] = colour[:3]
        return table

    def _choose_bands(self) -> list[int]:
        names = list(self._file.colorinterp)
        if all(c in names for c in (ColorInterp.red, ColorInterp.green, ColorInterp.blue)):
            return [names.index(c) + 1 for c in (ColorInterp.red, ColorInterp.green, ColorInterp.blue)]
        colours = [i + 1 for i, c in enumerate(names) if c != ColorInterp.alpha]
        if not colours:
            raise MapError(f"{self.path}: has no colour band, only alpha; give an image with 1, 3 or more bands")
        if len(colours) < 3 and np.dtype(self._file.dtypes[colours[0] - 1]).kind in "if":
            raise MapError(
                f"{self.path}: one band of {self._file.dtypes[colours[0] - 1]} is elevation (give it as --dem) or a "
                "measurement; convert it to an image first: gdal_translate -ot Byte -scale"
            )
        return colours[:3] if len(colours) >= 3 else colours[:1]

    def _find_stretch(self) -> tuple[float, float] | None:
        """Value range that maps to 0..255, the same for all bands to keep the colour balance; None for 8-bit images."""
        kind = np.dtype(self._file.dtypes[self.bands[0] - 1])
        if kind == np.uint8:
            return None
        if kind.kind == "c":
            raise MapError(f"{self.path}: complex pixels are not an image; give an image with 8, 16 bit or float bands")
        shrink = max(1.0, max(self.width_px, self.height_px) / SAMPLE_PX)
        shape = (max(1, int(self.height_px / shrink)), max(1, int(self.width_px / shrink)))
        try:
            sample = self._data.read(self.bands, out_shape=(len(self.bands), *shape)).astype(np.float64)
            mask = self._data.dataset_mask(out_shape=shape) > 0
        except RasterioError as error:
            raise MapError(f"{self.path}: cannot be read ({error}); check or download the file again") from None
        values = sample[:, mask]
        values = values[np.isfinite(values)]
        if values.size == 0:
            raise MapError(f"{self.path}: no valid pixel in the whole image")
        low, high = (float(v) for v in np.percentile(values, STRETCH_PERCENT))
        return (low, high) if high > low else (low, low + 1.0)


def open_raster(path: Path) -> Any:
    """Opens a raster. Raises MapError."""
    if not path.is_file():
        raise MapError(f"{path}: no such file; check the path of the imagery")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # reported below as an error
            return rasterio.open(path)
    except RasterioError:
        raise MapError(f"{path}: not an image that GDAL can read; give a GeoTIFF") from None


def ground_pixel_m(crs: CRS, x: float, y: float, pixel_x: float, pixel_y: float) -> float:
    """Geometric mean of a pixel's sides on the ground, metres, at (x, y) of the CRS."""
    across_m = ground_distance_m(crs, (x - 50 * pixel_x, y), (x + 50 * pixel_x, y)) / 100
    down_m = ground_distance_m(crs, (x, y - 50 * pixel_y), (x, y + 50 * pixel_y)) / 100
    return math.sqrt(across_m * down_m)


def ground_distance_m(crs: CRS, a: tuple[float, float], b: tuple[float, float]) -> float:
    lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform([a[0], b[0]], [a[1], b[1]])
    return float(Geod(ellps="WGS84").inv(lon_deg[0], lat_deg[0], lon_deg[1], lat_deg[1])[2])


def crs_of(dataset: Any, path: Path) -> CRS:
    """Horizontal CRS of a raster. Raises MapError when it is not georeferenced."""
    if dataset.transform == Affine.identity():
        raise MapError(f"{path}: has no georeference; give a GeoTIFF, or add one with gdal_translate -a_ullr -a_srs")
    if dataset.crs is None:
        raise MapError(f"{path}: has no coordinate system; add it with gdal_translate -a_srs EPSG:nnnnn IN OUT")
    authority = dataset.crs.to_authority()
    crs = CRS.from_authority(*authority) if authority else CRS.from_wkt(dataset.crs.to_wkt())
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    if not (crs.is_projected or crs.is_geographic):
        raise MapError(f"{path}: coordinate system '{crs.name}' is not on the earth; reproject with gdalwarp -t_srs")
    return crs


def _check_place(dataset: Any, crs: CRS, path: Path) -> None:
    """Raises MapError when the centre of a raster has no valid position: forward and inverse projection differ."""
    x, y = dataset.transform @ (dataset.width / 2, dataset.height / 2)
    step = math.hypot(dataset.transform.a, dataset.transform.d)
    try:
        lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
        back_x, back_y = Transformer.from_crs(4326, crs, always_xy=True).transform(lon_deg, lat_deg)
    except ProjError as error:
        raise MapError(
            f"{path}: no way from '{crs.name}' to WGS 84 ({error}); reproject with gdalwarp -t_srs"
        ) from None
    if not math.hypot(back_x - x, back_y - y) <= step:  # True for NaN and infinity, too
        raise MapError(
            f"{path}: its coordinates ({x:.6g}, {y:.6g}) lie outside the area of '{crs.name}'; check its georeference"
        )


def _utm_of(dataset: Any, crs: CRS) -> CRS:
    """UTM zone of the centre: EPSG 326zz north, 327zz south."""
    west, south, east, north = dataset.bounds
    lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform((west + east) / 2, (south + north) / 2)
    zone = int((lon_deg + 180.0) // 6.0) % 60 + 1
    return CRS.from_epsg((32600 if lat_deg >= 0 else 32700) + zone)
