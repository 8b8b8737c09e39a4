"""Initial position: an unknown one is replaced by a prior that covers the map."""

import math
import sqlite3
from pathlib import Path

import msgspec

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import InitialPosition, Origin

# 1-sigma per axis: the map is searched for an initial position that is less certain than this.
SEARCH_START_SIGMA_M = 100.0
# A start that is wrong lies evenly over so many of its 1-sigma about it, at most so far away. [tuned]
START_WINDOW_SIGMAS, START_WINDOW_MAX_M = 8.0, 500.0

Bounds = tuple[float, float, float, float]  # west, south, east, north [deg]


def start_is_unknown(origin: Origin) -> bool:
    """Whether the initial position is unknown, which the source states by an infinite sigma. Such an Origin is passed
    through ``with_map_center`` before it is published."""
    return math.isinf(origin.start_sigma_m)


def map_center(bounds: Bounds) -> tuple[float, float]:
    """Centre of the bounds -> (lat_deg, lon_deg)"""
    west, south, east, north = bounds
    return 0.5 * (south + north), 0.5 * (west + east)


def with_map_center(origin: Origin, bounds: Bounds) -> Origin:
    """An origin without initial position is moved to the centre of the map, with half of the longer side of the map as
    1-sigma. Other origins are returned unchanged."""
    if not start_is_unknown(origin):
        return origin
    lat_deg, lon_deg = map_center(bounds)
    half_m = max(LocalFrame(lat_deg, lon_deg).to_local(bounds[3], bounds[2]))
    return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=half_m)


def with_initial_position(origin: Origin, initial: InitialPosition | None) -> Origin:
    """The origin with the position sigma and the ground height of the initial position ``initial``. The reference point
    of the local frame does not change."""
    if initial is None or initial.sigma_m is None:
        return origin
    ground_m = origin.ground_amsl_m if initial.ground_amsl_m is None else initial.ground_amsl_m
    return msgspec.structs.replace(origin, start_sigma_m=initial.sigma_m, ground_amsl_m=ground_m)


def map_bounds(package: Path) -> Bounds:
    """Bounds from the manifest of a map package, for processes that do not open the map. Raises MapError."""
    try:
        db = sqlite3.connect(f"{package.resolve().as_uri()}?mode=ro", uri=True)
        try:
            row = db.execute("SELECT value FROM terrafix_manifest WHERE key = 'bounds_wgs84'").fetchone()
        finally:
            db.close()
        return msgspec.json.decode(row[0] if row else b"", type=Bounds)
    except (sqlite3.DatabaseError, msgspec.DecodeError) as error:
        raise MapError(f"{package}: damaged map package ({error}); build or copy it again") from None
