"""A start that nobody knows: somewhere on the map."""

import math
import sqlite3
from pathlib import Path

import msgspec

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import Origin, Start

SEARCHED_START_M = 100.0  # 1-sigma: a start that is known less well is searched on the map, not assumed

Bounds = tuple[float, float, float, float]  # west, south, east, north, degrees


def start_is_unknown(origin: Origin) -> bool:
    """A source that knows no start says an infinite sigma; such an Origin is ``placed`` before anybody hears it."""
    return math.isinf(origin.start_sigma_m)


def middle_of(bounds: Bounds) -> tuple[float, float]:
    """-> (lat_deg, lon_deg)"""
    west, south, east, north = bounds
    return 0.5 * (south + north), 0.5 * (west + east)


def placed(origin: Origin, bounds: Bounds) -> Origin:
    """An origin without a start: in the middle of the map, 1-sigma half of its longer side. Others as they are."""
    if not start_is_unknown(origin):
        return origin
    lat_deg, lon_deg = middle_of(bounds)
    half_m = max(LocalFrame(lat_deg, lon_deg).to_local(bounds[3], bounds[2]))
    return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=half_m)


def begun(origin: Origin, start: Start | None) -> Origin:
    """The origin, as it is when the flight begins at ``start`` of it: how well that is known, and the height of the
    ground there. The frame of reference stays where it was."""
    if start is None or start.sigma_m is None:
        return origin
    ground_m = origin.ground_amsl_m if start.ground_amsl_m is None else start.ground_amsl_m
    return msgspec.structs.replace(origin, start_sigma_m=start.sigma_m, ground_amsl_m=ground_m)


def map_bounds(package: Path) -> Bounds:
    """Of a map package, as its manifest has them: for a process that does not look at the map. Raises MapError."""
    try:
        db = sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)
        try:
            found = db.execute("SELECT value FROM terrafix_manifest WHERE key = 'bounds_wgs84'").fetchone()
        finally:
            db.close()
        return msgspec.json.decode(found[0] if found else b"", type=Bounds)
    except (sqlite3.DatabaseError, msgspec.DecodeError) as error:
        raise MapError(f"{package}: damaged map package ({error}); build or copy it again") from None
