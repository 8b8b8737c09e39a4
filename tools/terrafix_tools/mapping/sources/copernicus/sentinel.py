"""Sentinel-2 L2A: a cloudless mosaic at 10 m, computed by the service from the clear observations of a period."""

import datetime
import hashlib
from functools import partial
from pathlib import Path

from terrafix.core.errors import MapError
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.fetching.plan import FetchEstimate
from terrafix_tools.mapping.fetching.progress import OnProgress
from terrafix_tools.mapping.mosaic.compositing import Opener
from terrafix_tools.mapping.source import ImagerySource
from terrafix_tools.mapping.sources.copernicus.chunks import Chunk, ChunkRaster, fetch_chunks, process_request
from terrafix_tools.mapping.sources.copernicus.data_space import LICENCE, Copernicus, DataSpaceService, read_credentials
from terrafix_tools.mapping.sources.spec import SourceSpec
from terrafix_tools.mapping.sources.utm import utm_epsg

COLLECTION = "sentinel-2-l2a"
GSD_M = 10.0
CLOUD_PERCENT = 50  # maximum cloud cover of a scene
CHUNK_BYTES, CHUNK_S = 20e6, 30.0  # for the estimate: 2500 x 2500 px of four bands, and its computation
# Of the clear observations of a pixel, the one with the median red is used: a real observation without haze or shadow.
# Classes that are not clear: 0 no data, 1 saturated, 3 shadow, 8 to 10 cloud (L2A product definition, SCL).
EVALSCRIPT = """//VERSION=3
function setup() {
  return {
    input: [{ bands: ["B04", "B03", "B02", "SCL", "dataMask"] }],
    output: { bands: 4, sampleType: "UINT8" },
    mosaicking: "ORBIT"
  };
}
function evaluatePixel(samples) {
  const clear = samples.filter(s => s.dataMask === 1 && ![0, 1, 3, 8, 9, 10].includes(s.SCL));
  if (clear.length === 0) return [0, 0, 0, 0];
  clear.sort((a, b) => a.B04 - b.B04);
  const s = clear[Math.floor((clear.length - 1) / 2)];
  const shade = v => Math.max(0, Math.min(255, Math.round(2.5 * 255 * v)));
  return [shade(s.B04), shade(s.B03), shade(s.B02), 255];
}
"""


class SentinelJob:
    """One source with service = "sentinel-2", for one area."""

    def __init__(self, spec: SourceSpec, area: Area, cache: Path, service: DataSpaceService | None = None) -> None:
        self.spec, self._area = spec, area
        self._copernicus = Copernicus(read_credentials(), service or DataSpaceService())
        last = datetime.date.fromisoformat(spec.date) if spec.date else datetime.datetime.now(datetime.UTC).date()
        self._period = ((last - datetime.timedelta(days=spec.days)).isoformat(), last.isoformat())
        west, south, east, north = area.bounds_deg
        self._raster = ChunkRaster(utm_epsg((west + east) / 2, (south + north) / 2), GSD_M)
        key = hashlib.sha256("|".join((COLLECTION, EVALSCRIPT, *self._period)).encode()).hexdigest()[:16]
        self._folder = cache / f"sentinel-2-{key}"
        self._chunks = {self._path(chunk): chunk for chunk in self._raster.touched(area)}

    @property
    def date(self) -> str:
        """Last day of the period; its scenes are up to spec.days older."""
        return self._period[1]

    @property
    def licence(self) -> str:
        return self.spec.licence or f"{LICENCE} {self._period[1][:4]}"

    def estimate(self) -> FetchEstimate:
        """Raises MapError when there is no scene, FetchError, RefusedError (credentials)."""
        missing = self._missing()
        if missing:
            scenes = self._copernicus.scenes(COLLECTION, self._area.bounds_deg, self._period, CLOUD_PERCENT)
            if not scenes:
                raise MapError(
                    f"{self._area.name}: no Sentinel-2 scene with under {CLOUD_PERCENT} % clouds between "
                    f"{self._period[0]} and {self._period[1]}; give another date or more days"
                )
        connections = self._copernicus.client.limits.connections
        seconds = len(missing) * CHUNK_S / connections
        return FetchEstimate(self.spec.title, len(self._chunks), len(missing), len(missing) * CHUNK_BYTES, seconds)

    def fetch(self, on_progress: OnProgress) -> None:
        """Raises FetchError, RefusedError, OutputError."""
        days = {"from": f"{self._period[0]}T00:00:00Z", "to": f"{self._period[1]}T23:59:59Z"}
        data = {"type": COLLECTION, "dataFilter": {"timeRange": days, "maxCloudCoverage": CLOUD_PERCENT}}
        missing = self._missing()
        wanted = {p: (c, process_request(self._raster, c, data, EVALSCRIPT)) for p, c in missing.items()}
        fetch_chunks(self._copernicus, self._raster, wanted, on_progress)

    def openers(self) -> list[Opener]:
        return [partial(ImagerySource, path.absolute()) for path in self._chunks]

    def _missing(self) -> dict[Path, Chunk]:
        return {path: chunk for path, chunk in self._chunks.items() if not path.is_file()}

    def _path(self, chunk: Chunk) -> Path:
        return self._folder / f"{self._raster.epsg}-{chunk.column}-{chunk.row}.tif"
