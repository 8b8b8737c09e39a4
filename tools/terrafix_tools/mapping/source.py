"""Imagery for the map builder: any GDAL raster as north-up windows of 8-bit BGR with a mask."""

import math
import re
import uuid
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
import rasterio.shutil
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.enums import ColorInterp, MaskFlags, Resampling
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.transform import Affine
from rasterio.vrt import WarpedVRT
from rasterio.windows import Window

from terrafix.core.errors import MapError
from terrafix.map.format import InputStatement
from terrafix_tools.mapping.datum import check_datum, crs_of
from terrafix_tools.mapping.imagery import Imagery, ground_distance_m, ground_pixel_m
from terrafix_tools.mapping.sources.utm import utm_epsg
from terrafix_tools.mapping.ways import accuracy_to_wgs84

NODATA = re.compile("<NoDataValue>([^<]*)</NoDataValue>")
SAMPLE_PX = 1024  # side of the downsampled image that determines the value range of deep pixels
STRETCH_PERCENT = (0.5, 99.5)  # percentiles of the sample; 16-bit and float pixels outside saturate


class ImagerySource(Imagery):
    """North-up view of an image: pixel (r, c) covers [x_min + c px, y_max - r py) in `crs`. A context manager.

    ``hidden``: a raster on the image's own pixels, not zero where they are a collar. ``raw``: the image's own pixels,
    whatever their place on the ground."""

    def __init__(self, path: Path, *, hidden: Path | None = None, raw: bool = False) -> None:
        self.path = path
        self._file = open_raster(path)
        self._data: Any = self._file
        self._hidden: Any = None
        self._own_crs = crs = crs_of(self._file, path)
        transform: Affine = self._file.transform
        upright = transform.b == 0 and transform.d == 0 and transform.a > 0 and transform.e < 0
        _check_place(self._file, crs, path)
        self.warped = not raw and (not upright or crs.is_geographic)
        if crs.is_geographic and not raw:
            crs = _utm_of(self._file, crs)
        self.crs = crs
        self._colours = self._colour_table()
        self._nodata_is_held = self._file.nodata is None or holds(self._file.dtypes[0], self._file.nodata)
        # GDAL takes an alpha band for the mask only where it is the last of two or four, and there is no nodata value.
        alpha = [i for i, colour in enumerate(self._file.colorinterp, start=1) if colour == ColorInterp.alpha]
        self._alpha = alpha[0] if alpha else None
        if self.warped:
            self._data, self._hidden = self._north_up(crs, hidden)
        self.width_px, self.height_px = int(self._data.width), int(self._data.height)
        grid = Affine(1, 0, 0, 0, -1, self.height_px) if raw else self._data.transform
        self.pixel_x, self.pixel_y = float(grid.a), -float(grid.e)
        self.x_min, self.y_max = float(grid.c), float(grid.f)
        self.bands = self._choose_bands()
        # A mask in the file (alpha, mask band, nodata, in this order) is used; without one a collar is searched, of a
        # warped image on its own pixels.
        flags = [f for band in self._file.mask_flag_enums for f in band]
        by_value = self._nodata_is_held and self._file.nodata is not None
        self.file_has_mask = by_value or self._alpha is not None or MaskFlags.per_dataset in flags
        self.has_mask = self.warped or self.file_has_mask
        self._stretch = self._find_stretch()

    def close(self) -> None:
        if self._hidden is not None:
            self._hidden.close()
        if self._data is not self._file:
            self._data.close()
        self._file.close()

    @property
    def transform(self) -> Affine:
        return Affine(self.pixel_x, 0, self.x_min, 0, -self.pixel_y, self.y_max)

    @property
    def statements(self) -> tuple[InputStatement, ...]:
        """What the file was taken for."""
        crs, file = self._own_crs, self._file
        assumed = check_datum(file, self.path)
        x, y = file.transform @ (file.width / 2, file.height / 2)
        accuracy_m, missing = accuracy_to_wgs84(crs, x, y, assumed)
        nodata = stated_nodata(file)
        if nodata and (file.nodata is None or not self._nodata_is_held):
            assumed += (f"nodata value {nodata} ignored, {file.dtypes[0]} cannot hold it",)
        elif nodata and self._alpha is not None:
            assumed += (f"the alpha band is the mask, and not nodata {nodata}",)
        return (
            InputStatement(
                name=self.path.name,
                kind="imagery",
                unit=crs.axis_info[0].unit_name if crs.axis_info else "metre",
                datum=crs.name,
                accuracy_m=accuracy_m,
                assumed=assumed + missing,
            ),
        )

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
        return bands, self._read_mask(window)

    def _read_mask(self, window: Window) -> np.ndarray:
        if not self.has_mask:
            return np.full((int(window.height), int(window.width)), 255, np.uint8)
        mask = self._mask_of_file(window=window)
        if self._hidden is not None:
            mask = np.where(self._hidden.read(1, window=window) == 0, mask, 0).astype(np.uint8)
        return mask

    def _mask_of_file(self, **part: Any) -> np.ndarray:
        """Not zero where valid. ``part``: window or shape, as rasterio takes them."""
        if self._alpha is None:
            return np.asarray(self._data.dataset_mask(**part))
        return (self._data.read(self._alpha, **part) > 0).astype(np.uint8)

    def _to_bytes(self, bands: np.ndarray) -> np.ndarray:
        if self._colours is not None:
            return self._colours[bands[0].astype(np.uint8)].transpose(2, 0, 1)
        if self._stretch is None:
            return bands.astype(np.uint8, copy=False)
        low, high = self._stretch
        scaled = (np.nan_to_num(bands.astype(np.float32), nan=low) - low) * (255.0 / (high - low))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)

    def _north_up(self, crs: CRS, hidden: Path | None) -> tuple[Any, Any]:
        """The image resampled to a north-up grid of equal ground sampling, and the raster ``hidden`` likewise."""
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
        grid = {
            "crs": crs.to_wkt(),
            "transform": Affine(pixel, 0, x_min, 0, -pixel, y_max),
            "width": math.ceil((float(x.max()) - x_min) / pixel),
            "height": math.ceil((y_max - float(y.min())) / pixel),
        }
        nodata = source.nodata if self._nodata_is_held and self._alpha is None else None
        view = WarpedVRT(
            source,
            **grid,
            resampling=Resampling.nearest if self._colours is not None else Resampling.bilinear,
            add_alpha=self._alpha is None and nodata is None,
            src_alpha=self._alpha or 0,
            src_nodata=nodata,
            nodata=nodata,
        )
        if hidden is None:
            return view, None
        return view, WarpedVRT(rasterio.open(hidden), **grid, resampling=Resampling.nearest)

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
            mask = self._mask_of_file(out_shape=shape) > 0 if self.has_mask else np.ones(shape, bool)
        except RasterioError as error:
            raise MapError(f"{self.path}: cannot be read ({error}); check or download the file again") from None
        values = sample[:, mask]
        values = values[np.isfinite(values)]
        if values.size == 0:
            raise MapError(f"{self.path}: no valid pixel in the whole image")
        low, high = (float(v) for v in np.percentile(values, STRETCH_PERCENT))
        return (low, high) if high > low else (low, low + 1.0)


def stated_nodata(file: Any) -> str:
    """The nodata value as the file states it, which rasterio leaves out where pixels cannot hold it; empty: none."""
    name = f"/vsimem/{uuid.uuid4().hex}.vrt"
    rasterio.shutil.copy(file, name, driver="VRT")
    try:
        with rasterio.open(name) as view:
            found = NODATA.search(" ".join(view.tags(ns="xml:VRT").values()))
    finally:
        rasterio.shutil.delete(name)
    return found[1] if found else ""


def holds(dtype: str, nodata: float) -> bool:
    """Whether a pixel of this type can have the value."""
    kind = np.dtype(dtype)
    if kind.kind not in "iu":
        return True
    limits = np.iinfo(kind)
    return math.isfinite(nodata) and nodata == int(nodata) and limits.min <= nodata <= limits.max


def open_raster(path: Path) -> Any:
    """Opens a raster. Raises MapError."""
    if not path.is_file():
        raise MapError(f"{path}: no such file; check the path of the imagery")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)  # reported below as an error
            return rasterio.open(path)
    except (RasterioError, UnicodeDecodeError):  # GDAL's message may quote the bytes of a damaged file
        raise MapError(f"{path}: not an image that GDAL can read; give a GeoTIFF") from None


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
    x, y = dataset.transform @ (dataset.width / 2, dataset.height / 2)
    lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
    return CRS.from_epsg(utm_epsg(lon_deg, lat_deg))
