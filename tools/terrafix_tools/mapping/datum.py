"""Where the coordinates of a raster are on the earth: its coordinate system, the way from its datum to WGS 84, and how
good that way is by PROJ's own statement (accuracies of EPSG's operations)."""

import math
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup
from rasterio.errors import RasterioError
from rasterio.transform import Affine

from terrafix.core.errors import MapError
from terrafix_tools.mapping.sources.utm import utm_epsg

UNNAMED = re.compile(r"unknown|not.?specified|unnamed|undefined|unspecified|user.?defined|unretrievable|custom", re.I)
WGS84_AXIS_M, WGS84_FLATTENING, AXIS_TOLERANCE_M, FLATTENING_TOLERANCE = 6_378_137.0, 298.257, 0.5, 0.01
# Datums on this ellipsoid follow the earth's centre, and differ by the drift of the plates: EPSG:1188, NAD83 to WGS 84.
EARTH_CENTRED_ACCURACY_M = 4.0  # [spec: EPSG:1188]
SAME_PLACE_M = 0.01  # two descriptions of one system
AROUND_DEG = 0.01  # half the side of the area for which PROJ is asked
BALLPARK = "Ballpark"  # PROJ's word for an operation that leaves the datum out


@dataclass(frozen=True)
class Way:
    """The operation from a coordinate system to WGS 84 at a place. ``accuracy_m`` None: not stated."""

    name: str
    accuracy_m: float | None
    is_ballpark: bool


def crs_of(dataset: Any, path: Path) -> CRS:
    """Horizontal coordinate system of a raster. Raises MapError: not georeferenced, not on the earth, or as
    ``check_datum``."""
    if dataset.transform == Affine.identity():
        raise MapError(f"{path}: {_without_transform(dataset, path)}")
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


def accuracy_to_wgs84(crs: CRS, x: float, y: float, assumed: tuple[str, ...]) -> tuple[float | None, tuple[str, ...]]:
    """Accuracy in metres of the way from a coordinate system to WGS 84 at (x, y) in it; None: not stated; and the grid
    of a better way that PROJ lacks. ``assumed``: as ``check_datum`` returns it."""
    way = way_to_wgs84(crs, x, y)
    if assumed and not crs.is_bound:
        return max(EARTH_CENTRED_ACCURACY_M, way.accuracy_m or 0.0), ()
    if way.accuracy_m is None:
        return None, ()
    better = _missing_grid(crs, x, y, way.accuracy_m)
    return way.accuracy_m, (better,) if better else ()


def way_to_wgs84(crs: CRS, x: float, y: float) -> Way:
    """The operation that PROJ uses at (x, y)."""
    try:
        transformer = Transformer.from_crs(crs, 4326, always_xy=True)
        transformer.transform(x, y)
    except ProjError:  # no operation, or none at this place: the caller's transformation says so
        return Way("", None, False)
    try:
        used = transformer.get_last_used_operation()
    except ProjError:  # there is only one
        used = transformer
    accuracy = 0.0 if used.description == "noop" else float(used.accuracy)  # noop: WGS 84 itself
    return Way(used.description, accuracy if accuracy >= 0.0 else None, BALLPARK in used.description)


def _missing_grid(crs: CRS, x: float, y: float, accuracy_m: float) -> str:
    """A word about the best operation whose grid is not installed; empty: none is better than ``accuracy_m``."""
    try:
        lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform(x, y)
        group = operations(crs, 4326, lon_deg, lat_deg)
    except ProjError:
        return ""
    lacking = lacking_grids(group)
    if lacking is None or not 0.0 <= lacking[1] < accuracy_m:
        return ""
    return f"{lacking[0]}: {accuracy_m:g} m instead of {lacking[1]:g} m"


def operations(source: CRS, target: int, lon_deg: float, lat_deg: float) -> TransformerGroup:
    """The operations of PROJ at a place, the best first; those that leave a datum out are none. Raises ProjError."""
    around = AreaOfInterest(lon_deg - AROUND_DEG, lat_deg - AROUND_DEG, lon_deg + AROUND_DEG, lat_deg + AROUND_DEG)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that the best one is not available is what is asked
        return TransformerGroup(source, target, always_xy=True, area_of_interest=around, allow_ballpark=False)


def lacking_grids(group: TransformerGroup) -> tuple[str, float] | None:
    """A word about the grids that are missing for the best operation, and its accuracy in metres (-1: not stated)."""
    for operation in sorted(group.unavailable_operations, key=lambda o: (o.accuracy < 0.0, o.accuracy)):
        grids = [grid.short_name for grid in operation.grids if not grid.available]
        if grids:
            sync = " ".join(f"--file {Path(grid).stem}" for grid in grids)
            return f"PROJ lacks the grid {', '.join(grids)} (pyproj sync {sync})", float(operation.accuracy)
    return None


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
