"""Copernicus GLO-30: elevation at 30 m for an area, from the Process API; heights above the geoid EGM2008."""

from pathlib import Path
from xml.sax.saxutils import escape

import rasterio

from terrafix.core.errors import OutputError
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mapping.fetching.progress import OnProgress
from terrafix_tools.mapping.sources.copernicus.chunks import ChunkRaster, fetch_chunks, process_request
from terrafix_tools.mapping.sources.copernicus.data_space import (
    MAX_REQUEST_PX,
    Copernicus,
    DataSpaceService,
    read_credentials,
)
from terrafix_tools.mapping.sources.utm import utm_epsg

NAME = "glo-30"
LICENCE = "(c) DLR e.V. 2010-2014 and (c) Airbus Defence and Space GmbH 2014-2018, provided under COPERNICUS"
GSD_M = 30.0
EVALSCRIPT = """//VERSION=3
function setup() {
  return { input: ["DEM"], output: { bands: 1, sampleType: "FLOAT32" } };
}
function evaluatePixel(sample) {
  return [sample.DEM];
}
"""
DATA = {"type": "dem", "dataFilter": {"demInstance": "COPERNICUS_30"}, "processing": {"upsampling": "BILINEAR"}}


def fetch_glo30(area: Area, cache: Path, on_progress: OnProgress, service: DataSpaceService | None = None) -> Path:
    """Fetches elevation; returns a GDAL VRT of the chunks that the area touches.

    Raises UsageError (no credentials), FetchError, RefusedError, OutputError."""
    west, south, east, north = area.bounds_deg
    raster = ChunkRaster(utm_epsg((west + east) / 2, (south + north) / 2), GSD_M)
    paths = {cache / NAME / f"{raster.epsg}-{c.column}-{c.row}.tif": c for c in raster.touched(area)}
    wanted = {p: (c, process_request(raster, c, DATA, EVALSCRIPT)) for p, c in paths.items() if not p.is_file()}
    if wanted:
        fetch_chunks(Copernicus(read_credentials(), service or DataSpaceService()), raster, wanted, on_progress)
    return _vrt(raster, list(paths))


def _vrt(raster: ChunkRaster, paths: list[Path]) -> Path:
    """One raster of all chunks (gdal.org, VRT driver)."""
    bounds = []
    for path in paths:
        with rasterio.open(path) as file:
            bounds.append(file.bounds)
    left, top = min(b.left for b in bounds), max(b.top for b in bounds)
    right, bottom = max(b.right for b in bounds), min(b.bottom for b in bounds)
    lines = [
        f'<VRTDataset rasterXSize="{(right - left) / GSD_M:.0f}" rasterYSize="{(top - bottom) / GSD_M:.0f}">',
        f"<SRS>EPSG:{raster.epsg}</SRS>",
        f"<GeoTransform>{left}, {GSD_M}, 0, {top}, 0, {-GSD_M}</GeoTransform>",
        '<VRTRasterBand dataType="Float32" band="1"><NoDataValue>nan</NoDataValue>',
    ]
    size = f'xSize="{MAX_REQUEST_PX}" ySize="{MAX_REQUEST_PX}"'
    for path, b in zip(paths, bounds, strict=True):
        offset = f'xOff="{(b.left - left) / GSD_M:.0f}" yOff="{(top - b.top) / GSD_M:.0f}"'
        lines.append(
            f'<SimpleSource><SourceFilename relativeToVRT="1">{escape(path.name)}</SourceFilename>'
            f'<SourceBand>1</SourceBand><SrcRect xOff="0" yOff="0" {size}/><DstRect {offset} {size}/></SimpleSource>'
        )
    lines.append("</VRTRasterBand></VRTDataset>")
    first, last = paths[0].stem, paths[-1].stem
    out = paths[0].parent / f"{first}_{last}_{len(paths)}.vrt"
    try:
        out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); check the space") from None
    return out
