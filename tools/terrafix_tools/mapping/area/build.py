"""`terrafix map build`: area, sources, estimate, downloads, elevation, vectors, package."""

import contextlib
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec
from rich.console import Console

from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix.map.package import MapPackage
from terrafix_tools.mapping.area.checks import check_area
from terrafix_tools.mapping.area.files import DEFAULT_BUFFER_KM, is_line, read_area
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.build import build_package, layer_of
from terrafix_tools.mapping.choices import Datum, Descriptors, Unit
from terrafix_tools.mapping.datum import crs_of
from terrafix_tools.mapping.fetching.progress import shown
from terrafix_tools.mapping.layers import ElevationInput, LayerInput, VectorInput
from terrafix_tools.mapping.orthomosaic.write import read_statement
from terrafix_tools.mapping.package.dem import DemSource
from terrafix_tools.mapping.package.height_values import height_statement, heights_of
from terrafix_tools.mapping.package.heights import to_amsl
from terrafix_tools.mapping.source import open_raster
from terrafix_tools.mapping.sources.copernicus import glo30
from terrafix_tools.mapping.sources.prepare import Preparation, Request
from terrafix_tools.mapping.sources.spec import SourceSpec, parse_sources, read_sources
from terrafix_tools.mapping.vectors.overpass import PUBLIC, fetch_overpass, overpass_features
from terrafix_tools.mapping.vectors.pbf import pbf_features
from terrafix_tools.mapping.vectors.tags import LICENCE as OSM_LICENCE
from terrafix_tools.mapping.workers import MAP_BUILD
from terrafix_tools.parallel.pool import default_workers
from terrafix_tools.parallel.scheduler import connect

OVERPASS = "overpass"
OFFERED_CORRIDOR_KM = 2.0
FINEST_GSD_M, COARSEST_GSD_M = 0.01, 100.0


@dataclass(frozen=True)
class Order:
    """The command line options of a build; the field names are those of the options."""

    out: Path
    area: str = ""
    buffer_km: float | None = None
    corridor_km: float | None = None
    source: Sequence[str] = ()
    sources: Path | None = None
    gsd_m: float | None = None
    dem: str = ""
    dem_datum: Datum | None = None  # None: as the file says
    dem_unit: Unit | None = None
    geoid: Path | None = None
    osm: str = ""
    osm_ce90_m: float | None = None
    date: str = ""
    licence: str = ""
    ce90_m: float | None = None
    descriptors: Descriptors = Descriptors.WEIGHTS_FREE
    null_agl_m: tuple[float, ...] = ()
    rate: float | None = None
    workers: int | None = None  # None: ``usual_workers``
    scheduler: str = ""
    cache: Path | None = None
    agreed: bool = False
    estimate_only: bool = False
    say: Console = field(default_factory=lambda: Console(stderr=True, soft_wrap=True))

    @property
    def cache_dir(self) -> Path:
        """Folder that keeps downloads between runs (freedesktop.org, XDG base directories)."""
        return self.cache or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "terrafix"


def build_order(order: Order) -> Path | None:
    """Writes the package and returns its path; None when only an estimate was requested.

    Raises UsageError, ConfigError, SourceError, MapError, OutputError: one line each."""
    _check_files(order)
    with contextlib.ExitStack() as stack:
        # Before the download, which may take hours.
        cluster = stack.enter_context(connect(order.scheduler, MAP_BUILD)) if order.scheduler else None
        if not order.area:
            layers, area = [_whole_image(order)], None
        else:
            area = read_area(order.area, buffer_km=order.buffer_km, corridor_km=order.corridor_km)
            found = _layers(order, area)
            if found is None:
                return None
            layers = found
        try:
            order.out.parent.mkdir(parents=True, exist_ok=True)
            made = tempfile.TemporaryDirectory(dir=order.out.parent, prefix=f".{order.out.name}.")
        except OSError as error:
            raise OutputError(f"{order.out}: cannot be written ({error.strerror}); choose another --out") from None
        scratch = stack.enter_context(made)
        elevation = _elevation(order, area, Path(scratch))
        vectors = _vectors(order, area)
        replaced = ", which was replaced" if order.out.is_file() else ""
        package = build_package(
            layers,
            order.out,
            elevation=elevation,
            vectors=vectors,
            descriptors=order.descriptors,
            null_agl_m=order.null_agl_m,
            workers=order.workers or default_workers(),
            cluster=cluster,
            progress=True,
        )
    opened = MapPackage.open(package)
    for statement in opened.manifest.inputs:
        order.say.print(statement.text(), highlight=False)
    order.say.print(f"{package}: written; 'terrafix map preview {package}' draws it", highlight=False)
    opened.close()
    order.say.print(f"{package.stat().st_size / 1e6:.1f} MB; written to {package}{replaced}", highlight=False)
    return package


def _check_files(order: Order) -> None:
    """Checks that needed files exist before the download, which may take hours."""
    for option, text in (("--dem", order.dem), ("--osm", order.osm), ("--geoid", str(order.geoid or ""))):
        if text and text not in (glo30.NAME, OVERPASS) and "://" not in text and not Path(text).is_file():
            raise MapError(f"{text}: no such file; check {option}")


def _whole_image(order: Order) -> LayerInput:
    if len(order.source) != 1 or order.sources or "://" in order.source[0]:
        raise UsageError("give one image (it is taken whole), or --area with --source for several or for the network")
    lengths = order.gsd_m, order.buffer_km, order.corridor_km
    if order.osm or order.dem == glo30.NAME or any(length is not None for length in lengths):
        raise UsageError("--osm, --dem glo-30, --gsd, --buffer and --corridor need --area, for example W,S,E,N")
    imagery = Path(order.source[0])
    if order.out.exists() and imagery.exists() and order.out.samefile(imagery):
        raise OutputError(f"{order.out}: would overwrite the imagery; give another --out")
    spec = with_statement(SourceSpec(path=str(imagery), date=order.date, ce90_m=order.ce90_m))
    return layer_of(imagery, date=spec.date, licence=order.licence, ce90_m=spec.ce90_m)


def _layers(order: Order, area: Area) -> list[LayerInput] | None:
    if order.gsd_m is not None and not FINEST_GSD_M <= order.gsd_m <= COARSEST_GSD_M:
        raise UsageError(f"--gsd {order.gsd_m:g}: give metres per pixel between {FINEST_GSD_M} and {COARSEST_GSD_M:g}")
    specs = _specs(order)
    size_km2 = check_area(area)
    order.say.print(f"{area.name}: {size_km2:,.1f} km2 with its buffer", highlight=False)
    for note in area.notes:
        order.say.print(f"{area.name}: {note}", highlight=False)
    if order.buffer_km is None and order.corridor_km is None:
        order.say.print(_area_hint(order.area), highlight=False)
    preparation = Preparation(Request(area, specs, order.cache_dir, order.out, order.gsd_m), order.say)
    estimates = preparation.estimate()
    if order.estimate_only:
        return None
    preparation.fetch(estimates, agreed=order.agreed)
    return preparation.layers()


def _area_hint(area: str) -> str:
    """Hint at smaller areas, for a user who did not set the buffer."""
    if not is_line(area):
        return f"the buffer is {DEFAULT_BUFFER_KM:g} km, for an open search; --buffer KM sets it, 0 is the area itself"
    size_km2 = read_area(area, corridor_km=OFFERED_CORRIDOR_KM).size_km2()
    return (
        f"the buffer is {DEFAULT_BUFFER_KM:g} km, for an open search; "
        f"--corridor {OFFERED_CORRIDOR_KM:g} along the mission would be {size_km2:,.1f} km2"
    )


def _specs(order: Order) -> list[SourceSpec]:
    specs = parse_sources(
        list(order.source), licence=order.licence, date=order.date, ce90_m=order.ce90_m, rate=order.rate
    )
    if order.sources:
        specs += read_sources(order.sources)
    if not specs and not order.osm:
        raise UsageError(
            "--area needs a --source: a GeoTIFF, .mbtiles, a {z}/{x}/{y} address, ...; or --osm, drawn as a map"
        )
    return [with_statement(spec) for spec in specs]


def with_statement(spec: SourceSpec) -> SourceSpec:
    """An orthomosaic of `terrafix map mosaic` is a layer of its own, of the date and accuracy that it states, where
    nothing else was given."""
    stated = read_statement(Path(spec.path)) if spec.path else None
    if stated is None:
        return spec
    return msgspec.structs.replace(
        spec,
        date=spec.date or stated.date,
        ce90_m=stated.ce90_m if spec.ce90_m is None else spec.ce90_m,
        layer=spec.layer or f"flight {stated.flight} {stated.date}".strip(),
    )


def _elevation(order: Order, area: Area | None, scratch: Path) -> ElevationInput | None:
    if not order.dem:
        return None
    datum, licence, path = order.dem_datum, "", Path(order.dem)
    if order.dem == glo30.NAME:
        assert area is not None
        datum, licence = Datum.EGM2008, glo30.LICENCE
        with shown(order.say, glo30.NAME) as on_progress:
            path = glo30.fetch_glo30(area, order.cache_dir, on_progress)
    used, note = to_amsl(path, datum, scratch / "amsl.tif", order.geoid, order.dem_unit)
    with open_raster(path) as file:
        heights, crs = heights_of(file, str(path), order.dem_unit, datum), crs_of(file, path)
        centre = file.transform @ (file.width / 2, file.height / 2)
        done = "" if heights.datum is Datum.EGM96 else note
        statement = height_statement(file, path, heights, crs, centre, done)
    unit = order.dem_unit if used == path else None
    opener = partial(DemSource, used.absolute(), unit=unit, datum=datum or Datum.EGM96)
    return ElevationInput(opener, source=path.name, licence=licence, statement=statement)


def _vectors(order: Order, area: Area | None) -> VectorInput | None:
    if not order.osm:
        return None
    assert area is not None
    if order.osm == OVERPASS or "://" in order.osm:
        url = PUBLIC if order.osm == OVERPASS else order.osm
        with shown(order.say, "OpenStreetMap") as on_progress:
            paths = fetch_overpass(url, area, order.cache_dir, on_progress)
        features, source = overpass_features(paths, area), url
    else:
        features, source = pbf_features(Path(order.osm), area), Path(order.osm).name
    return VectorInput(features, source, licence=OSM_LICENCE, drawn_in=area, ce90_m=order.osm_ce90_m)
