"""Images of the Process API on a fixed raster of one UTM zone, cached as files: an area is fetched once."""

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rasterio
from pyproj import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import RasterioError
from rasterio.io import MemoryFile
from rasterio.transform import Affine

from terrafix.core.errors import OutputError
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.fetching.progress import DownloadProgress, OnProgress
from terrafix_tools.mapping.sources.copernicus.data_space import MAX_REQUEST_PX, Copernicus

RGBA = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
OGC_EPSG = "http://www.opengis.net/def/crs/EPSG/0/"


class Chunk(NamedTuple):
    """Position on the raster, in chunks from the zone's origin."""

    column: int
    row: int  # increases to the south


@dataclass(frozen=True)
class ChunkRaster:
    """Chunks of MOST_PX pixels per side in one UTM zone."""

    epsg: int
    pixel_m: float

    @property
    def span_m(self) -> float:
        return MAX_REQUEST_PX * self.pixel_m

    def bounds(self, chunk: Chunk) -> tuple[float, float, float, float]:
        """x_min, y_min, x_max, y_max."""
        x_min, y_max = chunk.column * self.span_m, -chunk.row * self.span_m
        return x_min, y_max - self.span_m, x_min + self.span_m, y_max

    def touched(self, area: Area) -> list[Chunk]:
        placed = Placed(area, CRS.from_epsg(self.epsg))
        x_min, y_min, x_max, y_max = placed.bounds
        first = Chunk(int(x_min // self.span_m), int(-y_max // self.span_m))
        width = int(x_max // self.span_m) - first.column + 1
        height = int(-y_min // self.span_m) - first.row + 1
        corner = Affine(self.span_m, 0, first.column * self.span_m, 0, -self.span_m, -first.row * self.span_m)
        inside = placed.burn(corner, width, height, touched=True)
        return [Chunk(first.column + int(c), first.row + int(r)) for r, c in np.argwhere(inside)]


def process_request(raster: ChunkRaster, chunk: Chunk, data: dict[str, Any], evalscript: str) -> dict[str, Any]:
    """Body of a Process API request for one chunk. ``data``: type, dataFilter, processing."""
    return {
        "input": {
            "bounds": {"bbox": list(raster.bounds(chunk)), "properties": {"crs": f"{OGC_EPSG}{raster.epsg}"}},
            "data": [data],
        },
        "output": {
            "width": MAX_REQUEST_PX,
            "height": MAX_REQUEST_PX,
            "responses": [{"identifier": "default", "format": {"type": "image/tiff"}}],
        },
        "evalscript": evalscript,
    }


def fetch_chunks(
    copernicus: Copernicus,
    raster: ChunkRaster,
    wanted: Mapping[Path, tuple[Chunk, dict[str, Any]]],
    on_progress: OnProgress,
) -> None:
    """Fetches each request into its file; a file is complete or missing.

    Raises FetchError, RefusedError, OutputError; completed files remain."""
    progressed = DownloadProgress(len(wanted))

    def one(path: Path) -> int:
        chunk, request = wanted[path]
        data = copernicus.picture(request)
        _write_file(data, raster, chunk, path)
        return len(data)

    with ThreadPoolExecutor(copernicus.client.limits.connections) as pool:
        running = [pool.submit(one, path) for path in wanted]
        try:
            for done in as_completed(running):
                progressed.size_bytes += done.result()
                progressed.tiles += 1
                on_progress(progressed)
        except BaseException:
            copernicus.client.pace.stop()
            pool.shutdown(wait=True, cancel_futures=True)
            raise


def _write_file(data: bytes, raster: ChunkRaster, chunk: Chunk, path: Path) -> None:
    """Writes a GeoTIFF whose fourth band is marked as the mask, which the service does not do."""
    x_min, _, _, y_max = raster.bounds(chunk)
    place = Affine(raster.pixel_m, 0, x_min, 0, -raster.pixel_m, y_max)
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with MemoryFile(data) as memory, memory.open() as file:
            bands = file.read()
        profile: dict[str, Any] = {"driver": "GTiff", "count": bands.shape[0], "dtype": bands.dtype, "tiled": True}
        profile |= {"height": bands.shape[1], "width": bands.shape[2], "compress": "deflate"}
        with rasterio.open(part, "w", crs=f"EPSG:{raster.epsg}", transform=place, **profile) as out:
            if bands.shape[0] == 4:
                out.colorinterp = RGBA
            out.write(bands)
        part.replace(path)
    except (OSError, RasterioError) as error:
        raise OutputError(f"{path}: cannot be written ({error}); check the space") from None
    finally:
        part.unlink(missing_ok=True)
