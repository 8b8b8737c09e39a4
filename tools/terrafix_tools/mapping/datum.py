"""Where the coordinates of a raster are on the earth: its coordinate system, and what is assumed about its datum."""

import math
import re
from pathlib import Path
from typing import Any

from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from rasterio.errors import RasterioError
from rasterio.transform import Affine

from terrafix.core.errors import MapError
from terrafix_tools.mapping.sources.utm import utm_epsg
from terrafix_tools.mapping.ways import way_to_wgs84

UNNAMED = re.compile(r"unknown|not.?specified|unnamed|undefined|unspecified|user.?defined|unretrievable|custom", re.I)
WGS84_AXIS_M, WGS84_FLATTENING, AXIS_TOLERANCE_M, FLATTENING_TOLERANCE = 6_378_137.0, 298.257, 0.5, 0.01
SAME_PLACE_M = 0.01  # two descriptions of one system


def crs_of(dataset: Any, path: Path) -> CRS:
    """Horizontal coordinate system of a raster. Raises MapError: not georeferenced, not on the earth, or as
    ``check_datum``."""
    if dataset.transform == Affine.identity():
        try:
            missing = _without_transform(dataset, path)
        except UnicodeDecodeError:
            missing = "what places it on the earth is damaged; download or export the file again"
        raise MapError(f"{path}: {missing}")
    stated = stated_crs(dataset, path)
    if stated is None:
        raise MapError(f"{path}: has no coordinate system; add it with gdal_translate -a_srs EPSG:nnnnn IN OUT")
    crs = _horizontal(stated)
    authority = dataset.crs.to_authority()  # by the file, or a guess of 70 % and more
    if authority:
        listed = _horizontal(CRS.from_authority(*authority))
        place = dataset.transform @ (dataset.width / 2, dataset.height / 2)
        if _datum_name(listed) == _datum_name(crs) or _is_same_place(listed, crs, *place):
            crs = listed
    if not (crs.is_projected or crs.is_geographic or crs.is_bound):
        raise MapError(f"{path}: coordinate system '{crs.name}' is not on the earth; reproject with gdalwarp -t_srs")
    check_datum(dataset, path)
    return crs


def stated_crs(dataset: Any, path: Path) -> CRS | None:
    """The coordinate system that a raster names, as it names it; None: none. Raises MapError: damaged."""
    try:
        return None if dataset.crs is None else CRS.from_wkt(dataset.crs.to_wkt())
    except (UnicodeDecodeError, ProjError, RasterioError) as error:
        raise MapError(
            f"{path}: its coordinate system cannot be read ({error}); set it with gdal_translate -a_srs EPSG:nnnnn"
        ) from None


def check_datum(dataset: Any, path: Path) -> tuple[str, ...]:
    """What is assumed about the datum that the file itself names. Raises MapError: not named, or without a known way to
    WGS 84, and on an ellipsoid whose datums are hundreds of metres apart."""
    stated = stated_crs(dataset, path)
    if stated is None:
        return ()
    crs = _horizontal(stated)
    base = (crs.source_crs if crs.is_bound else None) or crs
    named = bool(base.datum) and not UNNAMED.search(_datum_name(base))
    shift = list(crs.coordinate_operation.towgs84) if crs.is_bound and crs.coordinate_operation else []
    if any(shift):
        return ("the file states its own shift to WGS 84, of unknown accuracy",)
    way = way_to_wgs84(crs, *(dataset.transform @ (dataset.width / 2, dataset.height / 2)))
    if named and not way.is_ballpark and not shift:
        return ()
    ellipsoid = base.ellipsoid
    if ellipsoid is None or not _is_earth_centred(ellipsoid):
        what = (
            f"its datum '{_datum_name(base)}' has no known way to WGS 84 here" if named else "does not name its datum"
        )
        raise MapError(
            f"{path}: {what} (ellipsoid {ellipsoid.name if ellipsoid else 'unknown'}), which may be hundreds of metres "
            "off; state its coordinate system with gdal_translate -a_srs EPSG:nnnnn IN OUT"
        )
    what = f"datum '{_datum_name(base)}' taken as WGS 84" if named else "datum not named: WGS 84 by its ellipsoid"
    return (what,)


def _horizontal(crs: CRS) -> CRS:
    if crs.is_compound:
        crs = crs.sub_crs_list[0]
    return crs.to_2d() if len(crs.axis_info) == 3 else crs


def _datum_name(crs: CRS) -> str:
    datum = crs.datum
    return "" if datum is None else datum.name.removesuffix(" ensemble")


def _is_earth_centred(ellipsoid: Any) -> bool:
    axis = abs(float(ellipsoid.semi_major_metre) - WGS84_AXIS_M) < AXIS_TOLERANCE_M
    return axis and abs(float(ellipsoid.inverse_flattening) - WGS84_FLATTENING) < FLATTENING_TOLERANCE


def _is_same_place(a: CRS, b: CRS, x: float, y: float) -> bool:
    """Whether (x, y) of two systems is one place."""
    try:
        lon_deg, lat_deg = Transformer.from_crs(a, 4326, always_xy=True).transform(x, y)
        other_lon_deg, other_lat_deg = Transformer.from_crs(b, 4326, always_xy=True).transform(x, y)
    except ProjError:
        return False
    apart_deg = math.hypot((lon_deg - other_lon_deg) * math.cos(math.radians(lat_deg)), lat_deg - other_lat_deg)
    return math.radians(apart_deg) * WGS84_AXIS_M < SAME_PLACE_M


def _without_transform(dataset: Any, path: Path) -> str:
    """What is missing, and the command that helps, for a raster without a geotransform."""
    points, points_crs = dataset.gcps
    if points and points_crs is not None:
        x, y = (sum(values) / len(points) for values in zip(*((p.x, p.y) for p in points), strict=True))
        try:
            to_wgs84 = Transformer.from_crs(CRS.from_wkt(points_crs.to_wkt()), 4326, always_xy=True)
            lon_deg, lat_deg = to_wgs84.transform(x, y)
        except (UnicodeDecodeError, ProjError, RasterioError):
            return "is placed by ground control points in a coordinate system that cannot be read; set -a_srs again"
        warp = f"gdalwarp -tps -r bilinear -t_srs EPSG:{_zone(lon_deg, lat_deg)} {path} OUT.tif"
        return f"is placed by {len(points)} ground control points only; warp it with: {warp}"
    if points:
        return f"has {len(points)} ground control points without a coordinate system; add -a_srs EPSG:nnnnn"
    if dataset.rpcs is not None:
        zone = _zone(dataset.rpcs.long_off, dataset.rpcs.lat_off)
        warp = f"gdalwarp -rpc -to RPC_DEM=DEM.tif -r bilinear -t_srs EPSG:{zone} {path} OUT.tif"
        return f"is placed by rational polynomials (RPC) only; warp it over an elevation model with: {warp}"
    if dataset.tags(ns="GEOLOCATION"):
        return f"is placed by arrays of positions only; warp it with: gdalwarp -geoloc -t_srs EPSG:4326 {path} OUT.tif"
    return "has no georeference; give a GeoTIFF, or add one with gdal_translate -a_ullr -a_srs"


def _zone(lon_deg: float, lat_deg: float) -> int:
    """EPSG code of the UTM zone of a place."""
    return utm_epsg(lon_deg, lat_deg) if math.isfinite(lon_deg) and math.isfinite(lat_deg) else 4326
