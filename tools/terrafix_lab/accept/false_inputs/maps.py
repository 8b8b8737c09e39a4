"""False maps: of another place, in a wrong datum, of a wrong scale, with other ground along a part of the route.

Each function writes a GeoTIFF from the flight's, and returns the reason why it cannot be done, or "". Raises MapError.
"""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import rasterio
from rasterio.errors import RasterioIOError
from rasterio.transform import Affine
from rasterio.warp import transform as warped

from terrafix.core.errors import MapError
from terrafix_tools.evaluate import Truth

TOO_LARGE = "the map is too large to be changed in memory"
METRES_PER_DEGREE = 111_320.0
LARGEST_PX = 120_000_000  # of one band: the whole raster is kept in memory
REACH = 0.75  # of the footprint's diagonal: the ground of a frame, and the search area beside it


def mirrored(given: Path, out: Path) -> str:
    """East and west exchanged: ground of the same kind, without any place of the flight."""
    image, profile = _read(given)
    return TOO_LARGE if image is None else _write(out, image[:, :, ::-1], profile)


def shifted(given: Path, out: Path, east_m: float, north_m: float) -> str:
    """The same picture with an offset of its coordinates, as of another datum."""
    image, profile = _read(given)
    if image is None:
        return TOO_LARGE
    per_e, per_n = _units_per_metre(profile)
    return _write(
        out, image, profile | {"transform": Affine.translation(east_m * per_e, north_m * per_n) @ profile["transform"]}
    )


def scaled(given: Path, out: Path, factor: float, about: Truth) -> str:
    """The same picture with pixels ``factor`` times as large on the ground; ``about`` is the fixed point."""
    image, profile = _read(given)
    if image is None:
        return TOO_LARGE
    (x,), (y,) = warped("EPSG:4326", profile["crs"], [about.lon_deg], [about.lat_deg])
    grown = Affine.translation(x, y) @ Affine.scale(factor) @ Affine.translation(-x, -y) @ profile["transform"]
    return _write(out, image, profile | {"transform": grown})


def put_in_place_of(other: Path, given: Path, out: Path) -> str:
    """The raster ``other`` of another place, centred on ``given``; its pixel size on the ground is unchanged."""
    image, theirs = _read(other)
    if image is None:
        return TOO_LARGE
    try:
        with rasterio.open(given) as source:
            ours = {"crs": source.crs, "transform": source.transform, "width": source.width, "height": source.height}
    except RasterioIOError as error:
        raise MapError(f"{given}: cannot be read ({error})") from None
    x, y = ours["transform"] @ (ours["width"] / 2, ours["height"] / 2)
    from_units, to_units = _units_per_metre(theirs), _units_per_metre(ours)
    size_x, size_y = (
        abs(size) / mine * here
        for size, mine, here in zip((theirs["transform"].a, theirs["transform"].e), from_units, to_units, strict=True)
    )
    corner = Affine.translation(x - size_x * theirs["width"] / 2, y + size_y * theirs["height"] / 2)
    return _write(out, image, theirs | {"crs": ours["crs"], "transform": corner @ Affine.scale(size_x, -size_y)})


def stale_along(given: Path, out: Path, stretch: list[Truth], footprint_m: float) -> str:
    """The same picture, rotated by 180 degrees around ``stretch``: real ground of the same kind at a wrong place."""
    image, profile = _read(given)
    if image is None:
        return "the map is too large to be turned around in memory"
    x, y = warped("EPSG:4326", profile["crs"], [t.lon_deg for t in stretch], [t.lat_deg for t in stretch])
    points = np.round(np.array([~profile["transform"] @ at for at in zip(x, y, strict=True)])).astype(np.int32)
    pixel_m = abs(float(profile["transform"].a))
    if profile["crs"].is_geographic:
        pixel_m *= METRES_PER_DEGREE * float(np.cos(np.radians(stretch[0].lat_deg)))
    mask = np.zeros(image.shape[1:], np.uint8)
    cv2.polylines(mask, [points.reshape(-1, 1, 2)], False, 255, max(1, round(2 * REACH * footprint_m / pixel_m)))
    return _write(out, np.where(mask[None] > 0, image[:, ::-1, ::-1], image), profile)


def _read(path: Path) -> tuple[np.ndarray | None, dict[str, Any]]:
    """-> (bands, H, W), None if it is too large for memory; and rasterio's profile."""
    try:
        with rasterio.open(path) as source:
            profile = dict(source.profile)
            large = source.width * source.height > LARGEST_PX
            return (None if large else source.read()), profile
    except RasterioIOError as error:
        raise MapError(f"{path}: cannot be read ({error})") from None


def _write(out: Path, image: np.ndarray, profile: dict[str, Any]) -> str:
    keys = ("width", "height", "count", "dtype", "crs", "transform", "nodata")
    known = {key: profile[key] for key in keys if profile.get(key) is not None}
    with rasterio.open(out, "w", driver="GTiff", compress="deflate", **known) as file:
        file.write(image)
    return ""


def _units_per_metre(profile: dict[str, Any]) -> tuple[float, float]:
    """Units of the map's coordinates per metre east and per metre north, at its centre."""
    middle = profile["transform"] @ (profile["width"] / 2, profile["height"] / 2)
    (lon,), (lat,) = warped(profile["crs"], "EPSG:4326", [middle[0]], [middle[1]])
    step = 1e-4  # degrees
    (x0, x1, x2), (y0, y1, y2) = warped("EPSG:4326", profile["crs"], [lon, lon + step, lon], [lat, lat, lat + step])
    east_m, north_m = step * METRES_PER_DEGREE * float(np.cos(np.radians(lat))), step * METRES_PER_DEGREE
    return float(np.hypot(x1 - x0, y1 - y0)) / east_m, float(np.hypot(x2 - x0, y2 - y0)) / north_m
