"""Builds a map package from a GeoTIFF: tiles at several scales, elevation, manifest. Streams; any size."""

import contextlib
import hashlib
import math
import os
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path

import cv2
import msgspec
import numpy as np
import rasterio
import typer
from pyproj import Transformer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from terrafix.anchor.map_format import FORMAT_VERSION, TILE_PX, Level, Manifest
from terrafix.anchor.map_package import MapPackage
from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mapping.collar import BLEED_PX, TRIM_PX, Collar, find_collar
from terrafix_tools.mapping.dem import DemSource
from terrafix_tools.mapping.gpkg import GpkgWriter, new_package
from terrafix_tools.mapping.source import ImagerySource

JPEG_QUALITY = 95  # 8-11 MB/km2 at 0.3 m/px on aerial photographs; artefacts stay below a grey level or two
PNG_LEVEL = 6  # partly valid tiles only, so that the mask stays exact
CHUNK_LEVELS = 3  # the source is read in chunks of 2^3 tiles a side (2048 px)
HASH_CHUNK = 1 << 20
GDAL_CACHE_MB = 256  # GDAL's own choice is 5 % of the machine's memory

BUILT_WITH = f"terrafix {version('terrafix')}, GDAL {rasterio.__gdal_version__}, OpenCV {cv2.__version__}"

Step = Callable[[], None]


def build(
    imagery: Path,
    out: Path,
    *,
    dem: Path | None = None,
    date: str = "",
    licence: str = "",
    ce90_m: float | None = None,
    progress: bool = False,
) -> Path:
    """Writes the package `out` from `imagery` (any GDAL raster with a CRS) and an elevation raster in metres AMSL.

    ``ce90_m``: radius that holds 90 % of the imagery's errors of position, as its producer states it.

    The same input gives the same bytes. Nothing is left at `out` or beside it when this fails or is interrupted.
    Raises MapError (imagery or elevation unusable) and OutputError."""
    _check_date(date)
    if out.is_dir():
        raise OutputError(f"{out}: is a folder; give the name of a file to write, for example {out / 'map.gpkg'}")
    if out.exists() and out.samefile(imagery):
        raise OutputError(f"{out}: would overwrite the imagery; give another --out")
    with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_MB), ImagerySource(imagery) as source, contextlib.ExitStack() as stack:
        heights = stack.enter_context(DemSource(dem, source.crs, source.bounds)) if dem else None
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.")))
            part = scratch / "part.gpkg"
            bar = stack.enter_context(_progress_bar(progress))
            collar = None if source.has_mask else find_collar(source, scratch / "collar.tif", bar)
            if collar:
                stack.callback(collar.close)
            _write(part, source, heights, collar, imagery, out.stem, date, licence, ce90_m, bar)
            with part.open("rb") as file:
                os.fsync(file.fileno())
            part.replace(out)
        except OSError as error:
            raise OutputError(f"{out}: cannot be written ({error.strerror or error}); check folder and space") from None
        except sqlite3.OperationalError as error:
            raise OutputError(f"{out}: cannot be written ({error}); check the space on the disk") from None
    return out


def ensure_package(
    path: Path, cache_dir: Path, *, dem: Path | None = None, date: str = "", licence: str = "", progress: bool = False
) -> Path:
    """A map package for `path`: itself when it is one, else built once into `cache_dir` and used again.

    The name of the cached file carries path, size and modification time of the sources. Raises like `build`."""
    if path.suffix.lower() == ".gpkg":
        return path
    if not path.is_file():
        raise MapError(f"{path}: no such map; give a map package (.gpkg) or a GeoTIFF")
    key = hashlib.sha256(f"{FORMAT_VERSION}|{date}|{licence}".encode())
    for source in (path, dem):
        if source and source.is_file():
            stat = source.stat()
            key.update(f"|{source.resolve()}|{stat.st_size}|{stat.st_mtime_ns}".encode())
    cached = cache_dir / f"{path.stem}-{key.hexdigest()[:16]}.gpkg"
    if cached.is_file():
        try:
            MapPackage.open(cached).close()
        except MapError:
            pass  # damaged in the cache: built again below
        else:
            return cached
    return build(path, cached, dem=dem, date=date, licence=licence, progress=progress)


def info(package: Path) -> None:
    """Prints the manifest as JSON, after a check of every tile. Raises MapError."""
    opened = MapPackage.open(package, verify=True)
    text = msgspec.json.format(msgspec.json.encode(opened.manifest), indent=2).decode()
    opened.close()
    typer.echo(text)


def preview(package: Path, out: Path, size_px: int) -> None:
    """Writes the whole map, north up, as a PNG with transparent voids. Raises MapError, OutputError."""
    opened = MapPackage.open(package)
    west, south, east, north = opened.manifest.bounds_wgs84
    local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
    e_min, n_min, e_max, n_max = local.bounds_m
    gsd_m = max(e_max - e_min, n_max - n_min) / size_px
    shape = max(1, round((e_max - e_min) / gsd_m)), max(1, round((n_max - n_min) / gsd_m))
    image, valid = local.window(e_min, n_max, *shape, gsd_m)
    opened.close()
    png = cv2.imencode(".png", np.dstack([image, np.where(valid, 255, 0).astype(np.uint8)]))[1]
    try:
        out.write_bytes(png.tobytes())
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None


def _write(
    part: Path,
    source: ImagerySource,
    heights: DemSource | None,
    collar: Collar | None,
    imagery: Path,
    name: str,
    date: str,
    licence: str,
    ce90_m: float | None,
    bar: Callable[[str, int | None], Step],
) -> None:
    levels = _levels(source)
    with new_package(part) as writer:
        writer.add_imagery_tables(source.crs, levels, source.bounds, name, date, licence)
        chunk_px = TILE_PX << CHUNK_LEVELS
        chunks = math.ceil(source.width_px / chunk_px) * math.ceil(source.height_px / chunk_px)
        pyramid = _Pyramid(source, collar, writer, levels, bar("imagery", chunks))
        pyramid.write()
        if not pyramid.any_valid:
            raise MapError(f"{imagery}: no valid pixel in the whole image")
        if heights:
            heights.write(writer, bar("elevation", heights.tile_count))
        to_wgs84 = Transformer.from_crs(source.crs, 4326, always_xy=True)
        bounds = tuple(round(float(v), 9) for v in to_wgs84.transform_bounds(*source.bounds, densify_pts=51))
        authority = source.crs.to_authority(min_confidence=100)
        writer.add_manifest(
            Manifest(
                format_version=FORMAT_VERSION,
                name=name,
                gsd_m=source.gsd_m,
                crs=":".join(authority) if authority else source.crs.to_wkt(),
                bounds_wgs84=(bounds[0], bounds[1], bounds[2], bounds[3]),
                date=date,
                licence=licence,
                source=imagery.name,
                source_sha256=_sha256(imagery),
                built_with=BUILT_WITH,
                has_dem=heights is not None,
                dem=heights.grid if heights else None,
                tiles=writer.tiles,
                checksum="",
                ce90_m=ce90_m,
            )
        )


def _levels(source: ImagerySource) -> list[Level]:
    """Levels from one tile to the source's own pixels; every matrix covers the same area (requirement 45)."""
    steps = max(0, math.ceil(math.log2(max(source.width_px, source.height_px) / TILE_PX)))
    columns = math.ceil(source.width_px / (TILE_PX << steps))
    rows = math.ceil(source.height_px / (TILE_PX << steps))
    return [
        Level(z, source.pixel_x * 2 ** (steps - z), source.pixel_y * 2 ** (steps - z), columns << z, rows << z)
        for z in range(steps + 1)
    ]


class _Pyramid:
    """Tiles of all levels, depth first: a tile is the mean of its four children, so only a path is in memory."""

    def __init__(
        self, source: ImagerySource, collar: Collar | None, writer: GpkgWriter, levels: list[Level], on_chunk: Step
    ) -> None:
        self._source, self._collar, self._writer, self._on_chunk = source, collar, writer, on_chunk
        self._finest = levels[-1].zoom
        self._root = levels[0]
        self.any_valid = False

    def write(self) -> None:
        for row in range(self._root.rows):
            for column in range(self._root.columns):
                self._tile(0, column, row, None)

    def _tile(self, zoom: int, column: int, row: int, chunk: np.ndarray | None) -> np.ndarray | None:
        """(256, 256, 4) uint8 BGR and mask of a tile, after writing it and all below it; None = nothing there.

        `chunk`: the source's pixels under this tile, once read."""
        depth = self._finest - zoom
        side = TILE_PX << depth
        if column * side >= self._source.width_px or row * side >= self._source.height_px:
            return None
        if chunk is None and depth <= CHUNK_LEVELS:
            chunk = self._read(column * side, row * side, side)
            self._on_chunk()
        if chunk is not None and not chunk[:, :, 3].any():
            return None
        if depth == 0:
            assert chunk is not None
            tile = chunk
        else:
            merged = np.zeros((2 * TILE_PX, 2 * TILE_PX, 4), np.uint8)
            half = side // 2
            for r in (0, 1):
                for c in (0, 1):
                    part = None
                    if chunk is not None:
                        part = chunk[r * half : (r + 1) * half, c * half : (c + 1) * half]
                    child = self._tile(zoom + 1, 2 * column + c, 2 * row + r, part)
                    if child is not None:
                        merged[r * TILE_PX : (r + 1) * TILE_PX, c * TILE_PX : (c + 1) * TILE_PX] = child
            tile = halve(merged)
            if not tile[:, :, 3].any():
                return None
        self.any_valid = True
        self._writer.add_tile(zoom, column, row, encode(tile))
        return tile

    def _read(self, column: int, row: int, side: int) -> np.ndarray:
        """(side, side, 4) uint8: BGR, zero where invalid, and the mask."""
        out = np.zeros((side, side, 4), np.uint8)
        right, bottom = min(column + side, self._source.width_px), min(row + side, self._source.height_px)
        margin = BLEED_PX + TRIM_PX if self._collar else 0
        left, top = max(0, column - margin), max(0, row - margin)
        width = min(right + margin, self._source.width_px) - left
        height = min(bottom + margin, self._source.height_px) - top
        image, mask = self._source.read(left, top, width, height)
        if self._collar:
            self._collar.remove(image, mask, left, top)
        image[mask == 0] = 0
        inner = slice(row - top, bottom - top), slice(column - left, right - left)
        out[: bottom - row, : right - column, :3] = image[inner]
        out[: bottom - row, : right - column, 3] = mask[inner]
        return out


def halve(tile: np.ndarray) -> np.ndarray:
    """(2h, 2w, 4) -> (h, w, 4): mean of the valid ones of four pixels; valid when at least two of them are."""
    parts = tile.reshape(tile.shape[0] // 2, 2, tile.shape[1] // 2, 2, 4).astype(np.uint16)
    total = parts[..., :3].sum(axis=(1, 3))  # invalid pixels are zero
    count = (parts[..., 3] > 0).sum(axis=(1, 3)).astype(np.uint16)
    out = np.zeros((*count.shape, 4), np.uint8)
    weight = np.maximum(count, 1)[..., None]
    valid = count >= 2
    out[..., :3] = np.where(valid[..., None], (total + weight // 2) // weight, 0)
    out[..., 3] = np.where(valid, 255, 0)
    return out


def encode(tile: np.ndarray) -> bytes:
    """JPEG when every pixel is valid, else PNG with alpha, both of which any GeoPackage reader knows."""
    if tile[:, :, 3].all():
        return cv2.imencode(".jpg", tile[:, :, :3], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    return cv2.imencode(".png", tile, [cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL])[1].tobytes()


def _check_date(date: str) -> None:
    parts = date.split("-")
    sizes = [len(p) for p in parts]
    if date and not (sizes == [4, 2, 2] and all(p.isdigit() for p in parts)):
        raise UsageError(f"date '{date}' of the imagery: write it YYYY-MM-DD")


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(HASH_CHUNK):
            digest.update(chunk)
    return digest.hexdigest()


@contextlib.contextmanager
def _progress_bar(shown: bool) -> Iterator[Callable[[str, int | None], Step]]:
    """Gives a function (name, steps or None) -> step()."""
    columns = (TextColumn("{task.description:>9}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), disable=not shown) as progress:

        def start(name: str, total: int | None) -> Step:
            task = progress.add_task(name, total=total)
            return lambda: progress.advance(task)

        yield start
