"""A map that shows other ground along a part of the route: the same raster, rotated by 180 degrees there."""

from pathlib import Path

import cv2
import numpy as np
import rasterio
from pyproj import Transformer
from rasterio.errors import RasterioIOError

from terrafix.core.errors import MapError
from terrafix_tools.evaluate import Truth

REACH = 0.75  # of the footprint's diagonal: the ground of a frame, and the search area beside it
LARGEST_PX = 120_000_000  # of one band: the whole raster is kept in memory


def stale_along(given: Path, out: Path, stretch: list[Truth], footprint_m: float) -> str:
    """Writes ``out``: ``given``, with its own picture rotated by 180 degrees around ``stretch``. That is real ground of
    the same kind at a wrong place. -> the reason why it cannot be done, or "". Raises MapError."""
    try:
        with rasterio.open(given) as source:
            if source.width * source.height > LARGEST_PX:
                return "the map is too large to be turned around in memory"
            to_map = Transformer.from_crs("EPSG:4326", source.crs, always_xy=True)
            image, profile = source.read(), source.profile
            places = [~source.transform @ to_map.transform(t.lon_deg, t.lat_deg) for t in stretch]
            pixel_m = _pixel_m(source, stretch[0])
    except RasterioIOError as error:
        raise MapError(f"{given}: cannot be read ({error})") from None
    mask = np.zeros(image.shape[1:], np.uint8)
    points = np.round(np.array(places)).astype(np.int32)
    cv2.polylines(mask, [points.reshape(-1, 1, 2)], False, 255, max(1, round(2 * REACH * footprint_m / pixel_m)))
    rotated = image[:, ::-1, ::-1]
    stale = np.where(mask[None] > 0, rotated, image)
    profile |= {"driver": "GTiff", "compress": "deflate", "photometric": None}
    with rasterio.open(out, "w", **{k: v for k, v in profile.items() if v is not None and k != "jpeg_quality"}) as file:
        file.write(stale)
    return ""


def _pixel_m(source: rasterio.DatasetReader, at: Truth) -> float:
    """Size of a pixel on the ground [m]."""
    size = abs(float(source.transform.a))
    if source.crs.is_geographic:
        return size * 111_320.0 * float(np.cos(np.radians(at.lat_deg)))
    return size
