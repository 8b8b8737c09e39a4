"""A tile server as a source: required tiles, missing tiles, and their download."""

import hashlib
import time
from functools import partial
from pathlib import Path

from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.polygons import Area, Placed
from terrafix_tools.mapping.fetching.fetch import Client
from terrafix_tools.mapping.fetching.plan import FetchEstimate, spread_sample
from terrafix_tools.mapping.fetching.progress import OnProgress
from terrafix_tools.mapping.fetching.tiles import TileDownload
from terrafix_tools.mapping.mosaic.compositing import Opener
from terrafix_tools.mapping.mosaic.cover import uncovered
from terrafix_tools.mapping.sources.spec import SourceSpec
from terrafix_tools.mapping.sources.tiles.files import open_tiles
from terrafix_tools.mapping.sources.tiles.grid import MERCATOR, tiles_of, zoom_for
from terrafix_tools.mapping.sources.tiles.image import image_side
from terrafix_tools.mapping.sources.tiles.imagery import TileImagery
from terrafix_tools.mapping.sources.tiles.store import TileStore
from terrafix_tools.mapping.sources.tiles.url_template import UrlTemplate
from terrafix_tools.mapping.sources.tiles.wmts import read_capabilities

DEFAULT_GSD_M = 0.5  # default for a server; fine enough for flights above 100 m


class TileJob:
    """One source with a url or a wmts, for one area."""

    def __init__(self, spec: SourceSpec, area: Area, gsd_m: float | None, cache: Path) -> None:
        self.spec, self._area = spec, area
        south, north = area.bounds_deg[1], area.bounds_deg[3]
        lat_deg = (south + north) / 2
        self.template, self.tile_px = UrlTemplate(spec.url), spec.tile_px
        zooms: tuple[int, ...] = ()
        if spec.wmts:
            layer = read_capabilities(_capabilities(spec), spec.layer_name, spec.wmts)
            self.template, self.tile_px, zooms = layer.template, layer.tile_px, layer.zooms
        wanted = spec.zoom if spec.zoom is not None else zoom_for(gsd_m or DEFAULT_GSD_M, lat_deg, self.tile_px)
        self.zoom = max([z for z in zooms if z <= wanted], default=min(zooms)) if zooms else wanted
        self.tiles = tiles_of(Placed(area, MERCATOR), self.zoom)
        key = hashlib.sha256(self.template.text.encode()).hexdigest()[:16]
        self.path = cache / f"{key}.mbtiles"

    def drop_covered(self, better: tuple[Opener, ...]) -> None:
        """Drops the tiles that better sources cover completely."""
        self.tiles = uncovered(self._area, better, self.tiles)

    def estimate(self) -> FetchEstimate:
        """Fetches a few tiles to measure their size. Raises as `TileDownload.run`, and MapError."""
        with self._store() as store:
            missing = store.missing(self.tiles)
            if not missing.count:
                return FetchEstimate(self.spec.title, self.tiles.count, 0, 0.0, 0.0)
            began_s = time.monotonic()
            sample = spread_sample(missing)
            download = self._download(store)
            download.run(sample, lambda _: None)
        done = download.progressed
        rate = min(done.done / max(time.monotonic() - began_s, 1e-3), self.spec.requests_per_s)
        left = missing.count - sample.count
        return FetchEstimate(self.spec.title, self.tiles.count, left, left * done.size_bytes / done.done, left / rate)

    def fetch(self, on_progress: OnProgress) -> None:
        """Raises as `TileDownload.run`, and MapError when the server has no tile in the area."""
        with self._store() as store:
            missing = store.missing(self.tiles)
            if missing.count:
                self._download(store).run(missing, on_progress)
            if self.tiles.count and not store.any_of(self.tiles):
                raise MapError(f"{self.spec.title}: the server has no tile of zoom {self.zoom} here; try another zoom")

    def openers(self) -> list[Opener]:
        return [partial(open_tile_imagery, self.path.absolute(), self.zoom, self.tile_px, self._area)]

    @property
    def date(self) -> str:
        return self.spec.date

    @property
    def licence(self) -> str:
        return self.spec.licence

    def _store(self) -> TileStore:
        return TileStore(self.path, self.spec.title)

    def _download(self, store: TileStore) -> TileDownload:
        client = Client(self.spec.title, self.spec.limits, self.spec.headers)
        return TileDownload(client, self.template.url, store, self.tile_px)


def open_tile_imagery(path: Path, zoom: int, tile_px: int, area: Area) -> TileImagery:
    return TileImagery(open_tiles(path), zoom, tile_px, Placed(area, MERCATOR))


def tile_file_opener(spec: SourceSpec, area: Area, gsd_m: float | None) -> Opener:
    """A local MBTiles or PMTiles file at its finest zoom, or at that of the requested resolution."""
    path = Path(spec.path)
    reader = open_tiles(path)
    try:
        zoom = max(reader.zooms)
        tile_px = image_side(reader.first(zoom), path)
        if gsd_m:
            lat_deg = (area.bounds_deg[1] + area.bounds_deg[3]) / 2
            zoom = min(zoom, max(zoom_for(gsd_m, lat_deg, tile_px), min(reader.zooms)))
        if spec.zoom is not None:
            if spec.zoom not in reader.zooms:
                raise MapError(f"{path}: has no zoom {spec.zoom}; it has {reader.zooms[0]} to {reader.zooms[-1]}")
            zoom = spec.zoom
    finally:
        reader.close()
    return partial(open_tile_imagery, path.absolute(), zoom, tile_px, area)


def _capabilities(spec: SourceSpec) -> bytes:
    response = Client(spec.title, spec.limits, spec.headers).request("GET", spec.wmts)
    if response is None:
        raise MapError(f"{spec.wmts}: nothing there; give the address of the server's GetCapabilities")
    return response
