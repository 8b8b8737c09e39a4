"""Builds a map package: imagery tiles at several scales, elevation, vectors, manifest. Streams inputs of any size."""

import contextlib
import dataclasses
import hashlib
import math
import os
import sqlite3
import tempfile
from collections.abc import Callable, Generator, Sequence
from functools import partial
from pathlib import Path

import msgspec
import rasterio
from pyproj import Transformer
from rasterio.errors import RasterioError

from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix.map.format import (
    DRAWN_TABLE,
    FORMAT_VERSION,
    IMAGERY_TABLE,
    DemGrid,
    InputStatement,
    Layer,
    Manifest,
    VectorTable,
)
from terrafix.map.package import MapPackage
from terrafix_engines.retrieval.pooled import PooledGradientDescriber
from terrafix_engines.store import sha256_of
from terrafix_tools.mapping.build_checks import check_date, check_out, check_reach
from terrafix_tools.mapping.choices import Descriptors
from terrafix_tools.mapping.imagery import Imagery
from terrafix_tools.mapping.layers import ElevationInput, LayerInput, VectorInput
from terrafix_tools.mapping.mosaic.accuracy import add_accuracy_estimates
from terrafix_tools.mapping.mosaic.collar import find_collar
from terrafix_tools.mapping.package.dem import TILES_PER_WORKER, DemSource, height_places, open_heights, write_elevation
from terrafix_tools.mapping.package.descriptors import write_descriptors
from terrafix_tools.mapping.package.gpkg import GpkgWriter, new_package
from terrafix_tools.mapping.package.null_model import add_null_models
from terrafix_tools.mapping.package.pyramid import BUILT_WITH, Pyramid, levels_of, open_renderer
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mapping.sources.collared import write_hidden
from terrafix_tools.mapping.statements import accuracy_with_datum, merged
from terrafix_tools.mapping.vectors.drawing import drawn_layer, spooled
from terrafix_tools.mapping.vectors.tables import write_vectors
from terrafix_tools.mapping.workers import GDAL_CACHE_BYTES, MAP_BUILD
from terrafix_tools.parallel.pool import (
    CHUNKS_PER_WORKER,
    Piece,
    PoolProvider,
    Processes,
    render_pieces,
)
from terrafix_tools.progress import Bar, progress_bar


def build(
    imagery: Path,
    out: Path,
    *,
    dem: Path | None = None,
    date: str = "",
    licence: str = "",
    ce90_m: float | None = None,
    workers: int = 1,
    progress: bool = False,
) -> Path:
    """Builds a package from one image (any GDAL raster with a CRS) and an elevation raster in metres AMSL."""
    check_out(out, imagery)
    layer = layer_of(imagery, date=date, licence=licence, ce90_m=ce90_m)
    elevation = ElevationInput(partial(DemSource, dem.absolute()), source=dem.name) if dem else None
    return build_package([layer], out, elevation=elevation, workers=workers, progress=progress)


def layer_of(imagery: Path, *, date: str = "", licence: str = "", ce90_m: float | None = None) -> LayerInput:
    """An image as a layer. ``ce90_m``: stated accuracy, the radius that contains 90 % of the position errors.

    Raises MapError and UsageError."""
    with ImagerySource(imagery) as source:  # validates it before the full read
        check_reach(imagery, source)
    return LayerInput(
        open=partial(ImagerySource, imagery.absolute()),  # a worker may have another working directory
        source=imagery.name,
        source_sha256=sha256_of(imagery),
        where=str(imagery),
        date=date,
        licence=licence,
        ce90_m=ce90_m,
    )


def build_package(
    layers: Sequence[LayerInput],
    out: Path,
    *,
    elevation: ElevationInput | None = None,
    vectors: VectorInput | None = None,
    descriptors: Descriptors = Descriptors.WEIGHTS_FREE,
    null_agl_m: Sequence[float] = (),
    workers: int = 1,
    cluster: PoolProvider | None = None,
    progress: bool = False,
) -> Path:
    """Writes the package `out`; without ``layers`` from the drawn vectors alone. ``workers``: processes that read and
    encode imagery and elevation and compute descriptors; ``cluster``: other computers that do it instead. Neither
    changes the bytes. ``null_agl_m``: heights above ground for which a null model is fitted.

    The result is deterministic. On failure or interruption, no file is left at `out` or beside it.
    With several workers the main module must be importable (``multiprocessing`` forkserver).
    Raises MapError (an input is unusable), UsageError and OutputError."""
    for layer in layers:
        check_date(layer.date)
    check_out(out)
    if null_agl_m and not layers:
        raise UsageError("--null-agl: a null model is fitted on imagery, and this map has none; leave it out")
    # Newest first; unknown dates last, in the given order.
    ordered = sorted(layers, key=lambda layer: layer.date, reverse=True)
    with rasterio.Env(GDAL_CACHEMAX=GDAL_CACHE_BYTES), contextlib.ExitStack() as stack:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.")))
            bar = stack.enter_context(progress_bar(progress))
            crew = cluster or stack.enter_context(Processes(workers, MAP_BUILD))
            part = scratch / "part.gpkg"
            with new_package(part) as (writer, db):
                one = _Build(writer, db, scratch, out.stem, descriptors, crew, bar)
                one.write(ordered, elevation, vectors)
            if len(layers) > 1:
                add_accuracy_estimates(part)
            if null_agl_m:
                add_null_models(part, null_agl_m)
            with part.open("rb") as file:
                os.fsync(file.fileno())
            part.replace(out)
        except RasterioError as error:  # some subclasses are OSErrors, too
            raise MapError(
                f"{out}: not built, a raster cannot be read or kept ({error}); check it, and space"
            ) from None
        except OSError as error:
            raise OutputError(f"{out}: cannot be written ({error.strerror or error}); check folder and space") from None
        except sqlite3.OperationalError as error:
            raise OutputError(f"{out}: cannot be written ({error}); check the space on the disk") from None
    return out


def ensure_package(
    path: Path, cache_dir: Path, *, dem: Path | None = None, date: str = "", licence: str = "", progress: bool = False
) -> Path:
    """A map package for `path`: the path itself if it is a package, else one that is built once and cached.

    The cached file's name contains path, size and modification time of the sources. Raises like `build`."""
    if path.suffix.lower() == ".gpkg":
        return path
    if not path.is_file():
        raise MapError(f"{path}: no such map; give a map package (.gpkg) or a GeoTIFF")
    key = hashlib.sha256(f"{FORMAT_VERSION}|{PooledGradientDescriber.name}|{date}|{licence}".encode())
    for source in (path, dem):
        if source and source.is_file():
            stat = source.stat()
            key.update(f"|{source.resolve()}|{stat.st_size}|{stat.st_mtime_ns}".encode())
    cached = cache_dir / f"{path.stem}-{key.hexdigest()[:16]}.gpkg"
    if cached.is_file():
        try:
            opened = MapPackage.open(cached)
        except MapError:
            pass  # the cached file is damaged and is built again
        else:
            says_what_was_read = bool(opened.manifest.inputs)  # else by a version that read units and datums otherwise
            opened.close()
            if says_what_was_read:
                return cached
    return build(path, cached, dem=dem, date=date, licence=licence, progress=progress)


class _Build:
    """State of a package that is being written."""

    def __init__(
        self,
        writer: GpkgWriter,
        db: sqlite3.Connection,
        scratch: Path,
        name: str,
        descriptors: Descriptors,
        crew: PoolProvider,
        bar: Bar,
    ) -> None:
        self._writer, self._db, self._scratch, self._name = writer, db, scratch.absolute(), name
        self._descriptors, self._crew, self._bar = descriptors, crew, bar
        self._inputs: list[InputStatement] = []

    def write(self, layers: list[LayerInput], elevation: ElevationInput | None, vectors: VectorInput | None) -> None:
        written: list[Layer] = []
        dem: DemGrid | None = None
        for number, layer in enumerate(layers, start=1):
            table = IMAGERY_TABLE if number == 1 else f"{IMAGERY_TABLE}_{number}"
            given = self._without_collar(layer, table)
            with given.open() as source:
                written.append(self._layer(given, source, table))
                if number == 1 and elevation:
                    dem = self._elevation(elevation, source)
        tables: tuple[VectorTable, ...] = ()
        if vectors and vectors.drawn_in:
            drawn = drawn_layer(vectors, vectors.drawn_in, self._scratch)
            features = spooled(vectors, self._scratch, drawn.crs)
            tables = write_vectors(self._writer, self._db, dataclasses.replace(vectors, features=features))
            with drawn.given.open() as source:
                if not written and elevation:
                    dem = self._elevation(elevation, source)
                if tables:
                    written.append(self._layer(drawn.given, source, DRAWN_TABLE))
        elif vectors:
            tables = write_vectors(self._writer, self._db, vectors)
        if not written:
            raise MapError("no road, water or building lies in this area; check --osm and --area")
        self._manifest(written, dem, tables)

    def _without_collar(self, given: LayerInput, table: str) -> LayerInput:
        """An image that is warped and has no mask, with the collar of its own pixels hidden; others unchanged."""
        with given.open() as source:
            if not isinstance(source, ImagerySource) or not source.warped or source.file_has_mask:
                return given
            hidden = self._scratch / f"{table}-hidden.tif"
            if not write_hidden(source.path, hidden, self._bar):
                return given
            return dataclasses.replace(given, open=partial(ImagerySource, source.path, hidden=hidden))

    def _layer(self, given: LayerInput, source: Imagery, table: str) -> Layer:
        levels = levels_of(source)
        statements = source.statements
        ce90_m, origin, limited = accuracy_with_datum(given.ce90_m, statements)
        self._inputs += merged(statements, limited)
        authority = source.crs.to_authority(min_confidence=100)
        layer = Layer(
            table=table,
            date=given.date,
            licence=given.licence,
            source=given.source,
            source_sha256=given.source_sha256,
            ce90_m=ce90_m,
            ce90_origin=origin,
            gsd_m=source.gsd_m,
            crs=":".join(authority) if authority else source.crs.to_wkt(),
            x_min=source.x_min,
            y_max=source.y_max,
            bounds=source.bounds,
            levels=levels,
            tiles=0,
        )
        self._writer.add_imagery_table(layer, self._name)
        pyramid = Pyramid(source, levels, table, self._writer, layer.is_drawn)
        places = pyramid.places()
        self._crew.prepare(len(places), CHUNKS_PER_WORKER)
        collar_file = self._scratch / f"{table}-collar.tif"
        collar = None if source.has_mask else find_collar(source, collar_file, self._bar)
        if collar:
            collar.close()
        opener = partial(open_renderer, given.open, collar_file if collar else None, levels[-1].zoom, layer.is_drawn)
        rendered = render_pieces(opener, places, len(places), self._crew)
        with contextlib.closing(_count_steps(rendered, self._bar(table, len(places)))) as chunks:
            if not pyramid.write(chunks):
                raise MapError(f"{given.where or given.source}: no valid pixel in the whole image")
        described = None
        if self._descriptors is Descriptors.WEIGHTS_FREE:
            finest = levels[-1]
            unit_m = source.gsd_m / math.sqrt(finest.pixel_x * finest.pixel_y)
            described = write_descriptors(self._writer, self._db, layer, unit_m, self._crew, self._bar)
        return msgspec.structs.replace(layer, tiles=self._writer.tiles[table], descriptors=described)

    def _elevation(self, given: ElevationInput, source: Imagery) -> DemGrid:
        with given.open(source.crs, source.bounds) as elevation:  # validates it
            grid = elevation.grid
            self._inputs.append(given.statement or elevation.statement)
        places = height_places(grid)
        opener = partial(open_heights, given.open, source.crs, source.bounds)
        tiles = render_pieces(opener, places, len(places), self._crew, per_worker=TILES_PER_WORKER)
        with contextlib.closing(_count_steps(tiles, self._bar("elevation", len(places)))) as counted:
            return write_elevation(self._writer, given, grid, source.crs, counted)

    def _manifest(self, layers: list[Layer], dem: DemGrid | None, vectors: tuple[VectorTable, ...]) -> None:
        newest = layers[0]
        to_wgs84 = Transformer.from_crs(newest.crs, 4326, always_xy=True)
        bounds = tuple(round(float(v), 9) for v in to_wgs84.transform_bounds(*newest.bounds, densify_pts=51))
        self._writer.add_manifest(
            Manifest(
                format_version=FORMAT_VERSION,
                name=self._name,
                gsd_m=newest.gsd_m,
                crs=newest.crs,
                bounds_wgs84=(bounds[0], bounds[1], bounds[2], bounds[3]),
                date=newest.date,
                licence=newest.licence,
                source=newest.source,
                source_sha256=newest.source_sha256,
                built_with=BUILT_WITH,
                has_dem=dem is not None,
                dem=dem,
                tiles=sum(self._writer.tiles.values()),
                checksum="",
                ce90_m=newest.ce90_m,
                layers=tuple(layers),
                vectors=vectors,
                inputs=tuple(self._inputs),
                sealed=True,
            )
        )


def _count_steps(pieces: Generator[Piece, None, None], step: Callable[[], None]) -> Generator[Piece, None, None]:
    with contextlib.closing(pieces):
        for piece in pieces:
            step()
            yield piece
