"""Converts elevation heights from another vertical datum to AMSL as autopilots define it.

An autopilot's AMSL is that of the GNSS receiver: above the geoid EGM96. H_96 = H_2008 + N_2008 - N_96 = h - N_96, where
N is the geoid undulation above the WGS84 ellipsoid (NIMA TR8350.2, chapter 6). The grids of N are not part of
Terrafix."""

from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError
from rasterio.windows import Window

from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_tools.mapping.choices import Datum
from terrafix_tools.mapping.mosaic.warp import NODE_PX, spread
from terrafix_tools.mapping.source import crs_of, open_raster

BLOCK_PX = 1024


GRIDS = {Datum.EGM96: "us_nga_egm96_15.tif", Datum.EGM2008: "us_nga_egm08_25.tif"}  # names in PROJ's data


def to_amsl(dem: Path, datum: Datum, out: Path, geoid: Path | None = None) -> tuple[Path, str]:
    """The elevation file to use (``dem`` itself, or ``out`` with converted heights) and a note about its heights.

    ``geoid``: a grid of N of EGM96 in any format of PROJ (.gtx, .tif); default: PROJ's own, if it is installed.
    EGM2008 without both grids is used unchanged, because the two geoids are close; ellipsoidal heights are an error
    then, because they differ by up to 106 m. Raises MapError, UsageError (no grid), OutputError."""
    if datum is Datum.EGM96:
        return dem, "heights above EGM96, as given"
    below = _undulation(str(geoid) if geoid else GRIDS[Datum.EGM96])
    above = _undulation(GRIDS[Datum.EGM2008]) if datum is Datum.EGM2008 else None
    if geoid and below is None:
        raise UsageError(f"{geoid}: not a grid of a geoid that PROJ reads (.gtx or .tif); check --geoid")
    if datum is Datum.EGM2008 and (below is None or above is None):
        return (
            dem,
            "heights above EGM2008, used as AMSL: the grids of the geoids are not installed, usually under 1 m off",
        )
    if below is None:
        raise UsageError(
            f"{dem}: its heights count from the ellipsoid and no grid of the geoid is installed; "
            f"run 'pyproj sync --file {Path(GRIDS[Datum.EGM96]).stem}', or give --geoid FILE"
        )
    _convert(dem, out, above, below)
    return out, f"heights converted from {datum} to EGM96"


def _undulation(grid: str) -> Transformer | None:
    """Transformer from (lon, lat, 0) in degrees to N as the third value; None: PROJ has no such grid."""
    steps = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
        f"+step +proj=vgridshift +grids={grid} +multiplier=1 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    try:
        return Transformer.from_pipeline(steps)
    except ProjError:
        return None


def _convert(dem: Path, out: Path, above: Transformer | None, below: Transformer) -> None:
    source = open_raster(dem)
    with source:
        to_wgs84 = Transformer.from_crs(crs_of(source, dem), 4326, always_xy=True)
        profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": np.nan, "compress": "deflate"}
        profile |= {"width": source.width, "height": source.height, "tiled": True, "BIGTIFF": "IF_SAFER"}
        try:
            with rasterio.open(out, "w", crs=source.crs, transform=source.transform, **profile) as file:
                for row in range(0, source.height, BLOCK_PX):
                    for column in range(0, source.width, BLOCK_PX):
                        size = min(BLOCK_PX, source.width - column), min(BLOCK_PX, source.height - row)
                        window = Window(column, row, *size)
                        height_m = source.read(1, window=window, masked=True).astype(np.float32).filled(np.nan)
                        change_m = _change_m(source.transform, to_wgs84, window, above, below)
                        file.write((height_m + change_m).astype(np.float32), 1, window=window)
        except (OSError, RasterioError) as error:
            raise OutputError(f"{out}: cannot be written ({error}); check the space") from None


def _change_m(
    transform: rasterio.Affine, to_wgs84: Transformer, window: Window, above: Transformer | None, below: Transformer
) -> np.ndarray:
    """Height correction of a window (height, width), interpolated from nodes, because a geoid is smooth.

    Raises MapError: the area is outside the grid."""
    columns = np.linspace(0, window.width - 1, max(2, window.width // NODE_PX + 1))
    rows = np.linspace(0, window.height - 1, max(2, window.height // NODE_PX + 1))
    c, r = np.meshgrid(window.col_off + columns + 0.5, window.row_off + rows + 0.5)
    x = transform.a * c + transform.b * r + transform.c
    y = transform.d * c + transform.e * r + transform.f
    lon_deg, lat_deg = to_wgs84.transform(x, y)
    zero = np.zeros_like(lon_deg)
    change_m = -np.asarray(below.transform(lon_deg, lat_deg, zero)[2])
    if above is not None:
        change_m = change_m + np.asarray(above.transform(lon_deg, lat_deg, zero)[2])
    if not np.isfinite(change_m).all():
        raise MapError(
            f"the grid of the geoid ends near {lat_deg.mean():.2f}, {lon_deg.mean():.2f}; give a larger --geoid"
        )
    return spread(change_m, columns, rows, int(window.width), int(window.height))
