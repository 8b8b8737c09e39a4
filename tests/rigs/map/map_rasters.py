"""Small generated GeoTIFFs for the tests of map builder and map reader."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.transform import Affine


def texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    """-> (3, height, width) uint8 RGB: smooth noise of several scales, without the values 0 and 255."""
    return _texture(height, width, seed).copy()


@lru_cache(maxsize=16)  # the wide blur costs more than the map that a test builds of it
def _texture(height: int, width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, 3), np.float32)
    for sigma_px, weight in ((2.5, 1.0), (12.0, 1.2), (40.0, 1.0)):
        layer = cv2.GaussianBlur(rng.normal(size=(height, width, 3)).astype(np.float32), (0, 0), sigma_px)
        image += weight * layer / layer.std()
    scaled = np.clip(128 + 30 * image, 5, 250).astype(np.uint8)
    return np.ascontiguousarray(scaled.transpose(2, 0, 1))


def write_tif(path: Path, bands: np.ndarray, crs: str | None, transform: Affine | None, **profile: Any) -> Path:
    """Writes bands (count, height, width). ``profile``: of rasterio, and also ``colorinterp`` and ``colormap``."""
    interpretation = profile.pop("colorinterp", None)
    palette = profile.pop("colormap", None)
    if transform is not None:
        profile["transform"] = transform
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=bands.shape[2],
        height=bands.shape[1],
        count=bands.shape[0],
        dtype=bands.dtype,
        crs=crs,
        **profile,
    ) as file:
        file.write(bands)
        if interpretation is not None:
            file.colorinterp = interpretation
        if palette is not None:
            file.write_colormap(1, palette)
    return path


def around(
    path: Path, bands: np.ndarray, crs: str, place_deg: tuple[float, float], pixel: float, **profile: Any
) -> Path:
    """Writes a GeoTIFF with its centre at ``place_deg``, latitude and longitude."""
    x, y = Transformer.from_crs(4326, crs, always_xy=True).transform(*place_deg[::-1])
    height, width = bands.shape[1:]
    corner = Affine(pixel, 0, x - width * pixel / 2, 0, -pixel, y + height * pixel / 2)
    return write_tif(path, bands, crs, corner, **profile)


def utm(path: Path, bands: np.ndarray, crs: str = "EPSG:32651", pixel_m: float = 0.5, **profile: Any) -> Path:
    """Writes a GeoTIFF whose top left corner is at easting 300 km, northing 2 600 km."""
    return write_tif(path, bands, crs, Affine(pixel_m, 0, 300_000.0, 0, -pixel_m, 2_600_000.0), **profile)
