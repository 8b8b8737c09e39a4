"""The way from a coordinate system to WGS 84, and how good it is by PROJ's own statement (accuracies of EPSG's
operations)."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest, TransformerGroup

# Datums on the ellipsoid of WGS 84 follow the earth's centre, and differ by the drift of the plates: NAD83 to WGS 84.
EARTH_CENTRED_ACCURACY_M = 4.0  # [spec: EPSG:1188]
AROUND_DEG = 0.01  # half the side of the area for which PROJ is asked
BALLPARK = "Ballpark"  # PROJ's word for an operation that leaves the datum out


@dataclass(frozen=True)
class Way:
    """The operation from a coordinate system to WGS 84 at a place. ``accuracy_m`` None: not stated."""

    name: str
    accuracy_m: float | None
    is_ballpark: bool


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
            return lacking_text(grids), float(operation.accuracy)
    return None


def lacking_text(grids: Sequence[str]) -> str:
    """Which grids are missing, and the command that installs them."""
    sync = " ".join(f"--file {Path(grid).stem}" for grid in grids)
    return f"PROJ lacks the grid {', '.join(grids)} (pyproj sync {sync})"
