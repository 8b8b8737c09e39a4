"""Converts elevation heights from another vertical datum to AMSL as autopilots define it.

An autopilot's AMSL is that of the GNSS receiver: above the geoid EGM96. H_96 = H_2008 + N_2008 - N_96 = h - N_96, where
N is the geoid undulation above the WGS84 ellipsoid (NIMA TR8350.2, chapter 6). The grids of N are not part of
Terrafix."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import rasterio
from pyproj import Transformer
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError
from rasterio.windows import Window

from terrafix.core.errors import MapError, OutputError, UsageError
from terrafix_tools.mapping.choices import Datum, Unit
from terrafix_tools.mapping.datum import crs_of, stated_crs
from terrafix_tools.mapping.mosaic.warp import NODE_PX, spread
from terrafix_tools.mapping.package.height_values import Heights, heights_of
from terrafix_tools.mapping.source import open_raster
from terrafix_tools.mapping.ways import lacking_grids, lacking_text, operations

BLOCK_PX = 1024
WGS84_EGM96 = 9707  # EPSG: WGS 84 + EGM96 height

GRIDS = {Datum.EGM96: "us_nga_egm96_15.tif", Datum.EGM2008: "us_nga_egm08_25.tif"}  # names in PROJ's data


def to_amsl(
    dem: Path, datum: Datum | None, out: Path, geoid: Path | None = None, unit: Unit | None = None
) -> tuple[Path, str]:
    """The elevation file to use (``dem`` itself, or ``out`` with converted heights, metres) and a note about its
    heights. ``datum``, ``unit``: as the user states them; None: as the file does.

    ``geoid``: a grid of N of EGM96 in any format of PROJ (.gtx, .tif); default: PROJ's own, if it is installed.
    EGM2008 and national heights without their grids are used unchanged, because mean sea levels are close; ellipsoidal
    heights are an error then, because they differ by up to 106 m. Raises MapError, UsageError (no grid), and
    OutputError."""
    with open_raster(dem) as file:
        heights = heights_of(file, str(dem), unit, datum)
    datum = heights.datum
    if datum is Datum.EGM96:
        return dem, "heights above EGM96, as given"
    if datum is None:
        return _from_national(dem, heights, out)
    below = _undulation(str(geoid) if geoid else GRIDS[Datum.EGM96])
    egm2008 = _undulation(GRIDS[Datum.EGM2008])
    above = egm2008 if datum is Datum.EGM2008 else None
    if geoid and below is None:
        raise UsageError(f"{geoid}: not a grid of a geoid that PROJ reads (.gtx or .tif); check --geoid")
    if datum is Datum.EGM2008 and (below is None or above is None):
        grids = [GRIDS[one] for one, grid in ((Datum.EGM96, below), (Datum.EGM2008, above)) if grid is None]
        return dem, f"heights above EGM2008, used as AMSL: {lacking_text(grids)}, usually under 1 m off"
    if below is None and egm2008 is not None:
        _convert(dem, heights, out, partial(_undulation_change_m, [egm2008]))
        lacking = lacking_text([GRIDS[Datum.EGM96]])
        return out, f"heights converted from {datum} to EGM2008, used as AMSL: {lacking}, usually under 1 m off"
    if below is None:
        raise UsageError(
            f"{dem}: its heights count from the ellipsoid and no grid of the geoid is installed; "
            f"run 'pyproj sync --file {Path(GRIDS[Datum.EGM96]).stem}', or give --geoid FILE, or --dem-datum"
        )
    changes = [below] if above is None else [below, above]
    _convert(dem, heights, out, partial(_undulation_change_m, changes))
    return out, f"heights converted from {datum} to EGM96"


def _from_national(dem: Path, heights: Heights, out: Path) -> tuple[Path, str]:
    """Conversion by the operation that PROJ knows best, if it has its grids."""
    name = heights.datum_name
    with open_raster(dem) as file:
        stated, horizontal = stated_crs(file, dem), crs_of(file, dem)
        x, y = file.transform @ (file.width / 2, file.height / 2)
    assert stated is not None  # crs_of has read it
    group = operations(stated, WGS84_EGM96, *Transformer.from_crs(horizontal, 4326, always_xy=True).transform(x, y))
    if group.transformers and group.best_available:
        change = group.transformers[0]
        to_horizontal = Transformer.from_crs(4326, horizontal, always_xy=True)

        def change_m(lon_deg: np.ndarray, lat_deg: np.ndarray) -> np.ndarray:
            x, y = to_horizontal.transform(lon_deg, lat_deg)
            return np.asarray(change.transform(x, y, np.zeros_like(x))[2])

        _convert(dem, heights, out, change_m)
        return out, f"heights converted from {name} to EGM96 ({change.description}, {change.accuracy:g} m)"
    lacking = lacking_grids(group)
    missing = lacking[0] if lacking else "PROJ knows no conversion"
    return dem, f"heights above {name}, used as AMSL: {missing}, usually under 2 m off"


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


def _undulation_change_m(changes: list[Transformer], lon_deg: np.ndarray, lat_deg: np.ndarray) -> np.ndarray:
    """Minus the undulation of the first grid, plus that of the second, where there is one."""
    zero = np.zeros_like(lon_deg)
    below, *above = (np.asarray(change.transform(lon_deg, lat_deg, zero)[2]) for change in changes)
    return above[0] - below if above else -below


ChangeM = Callable[[np.ndarray, np.ndarray], np.ndarray]  # of longitude and latitude in degrees


def _convert(dem: Path, heights: Heights, out: Path, change_m: ChangeM) -> None:
    source = open_raster(dem)
    with source:
        crs = crs_of(source, dem)
        to_wgs84 = Transformer.from_crs(crs, 4326, always_xy=True)
        profile = {"driver": "GTiff", "count": 1, "dtype": "float32", "nodata": np.nan, "compress": "deflate"}
        profile |= {"width": source.width, "height": source.height, "tiled": True, "BIGTIFF": "IF_SAFER"}
        try:
            with rasterio.open(out, "w", crs=crs.to_wkt(), transform=source.transform, **profile) as file:
                file.units = ("metre",)
                for row in range(0, source.height, BLOCK_PX):
                    for column in range(0, source.width, BLOCK_PX):
                        size = min(BLOCK_PX, source.width - column), min(BLOCK_PX, source.height - row)
                        window = Window(column, row, *size)
                        read = source.read(1, window=window, masked=True)
                        height_m = np.where(np.ma.getmaskarray(read), np.nan, heights.to_m(read.data))
                        height_m = height_m.astype(np.float32) + _spread_m(source.transform, to_wgs84, window, change_m)
                        file.write(height_m.astype(np.float32), 1, window=window)
        except (OSError, RasterioError) as error:
            raise OutputError(f"{out}: cannot be written ({error}); check the space") from None


def _spread_m(transform: rasterio.Affine, to_wgs84: Transformer, window: Window, change_m: ChangeM) -> np.ndarray:
    """Height correction of a window (height, width), interpolated from nodes, because a geoid is smooth.

    Raises MapError: the area is outside the grid."""
    columns = np.linspace(0, window.width - 1, max(2, window.width // NODE_PX + 1))
    rows = np.linspace(0, window.height - 1, max(2, window.height // NODE_PX + 1))
    c, r = np.meshgrid(window.col_off + columns + 0.5, window.row_off + rows + 0.5)
    x = transform.a * c + transform.b * r + transform.c
    y = transform.d * c + transform.e * r + transform.f
    lon_deg, lat_deg = to_wgs84.transform(x, y)
    nodes_m = change_m(lon_deg, lat_deg)
    if not np.isfinite(nodes_m).all():
        raise MapError(
            f"the grid of the geoid ends near {lat_deg.mean():.2f}, {lon_deg.mean():.2f}; give a larger --geoid"
        )
    return spread(nodes_m, columns, rows, int(window.width), int(window.height))
