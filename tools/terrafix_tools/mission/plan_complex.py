"""Complex items of a QGroundControl plan (surveys, scans, landings) as the simple ones that they become.

Formats: docs.qgroundcontrol.com "Plan file format". A survey and a corridor scan carry the items that are uploaded.
Those of a structure scan and of a landing are made by the ground station, and are followed here as far as their course
goes: once around the outline at the distance of the scan, and straight from the approach to the landing."""

import math
from typing import Any

from pyproj import Geod

from terrafix.core.errors import SourceError

TRANSECTS = ("survey", "CorridorScan")
LANDINGS = ("fwLandingPattern", "vtolLandingPattern")
WAYPOINT, LAND = 16, 21  # MAV_CMD
AMSL, HOME = 0, 3  # MAV_FRAME
EARTH = Geod(ellps="WGS84")


def simple_items(where: str, entry: dict[str, Any]) -> list[Any]:
    """Entries of type SimpleItem. ``where``: file and number, for messages. Raises SourceError."""
    kind = str(entry.get("complexItemType"))
    try:
        if kind in TRANSECTS:
            return _transects(where, kind, entry)
        if kind == "StructureScan":
            return _around(entry)
        if kind in LANDINGS:
            return _landing(entry)
    except (KeyError, TypeError, ValueError, IndexError):
        raise SourceError(f"{where}: a '{kind}' without its places; save the plan again in QGroundControl") from None
    known = ", ".join((*TRANSECTS, "StructureScan", *LANDINGS))
    raise SourceError(f"{where}: '{kind}' is not supported; known: {known}; put waypoints in its place")


def _transects(where: str, kind: str, entry: dict[str, Any]) -> list[Any]:
    items = entry["TransectStyleComplexItem"]["Items"]
    if not isinstance(items, list) or not items:
        raise SourceError(f"{where}: a '{kind}' without items; open the plan in QGroundControl and save it again")
    return items


def _around(entry: dict[str, Any]) -> list[Any]:
    """The outline, its corners moved away from its middle by the distance of the scan, back to the first one."""
    corners = [(float(lat), float(lon)) for lat, lon, *_ in entry["polygon"]]
    distance_m = float(entry["CameraCalc"]["DistanceToSurface"])
    height_m = float(entry.get("EntranceAltitude", entry.get("EntranceAlt", entry.get("Altitude", math.nan))))
    middle_lat, middle_lon = (sum(values) / len(corners) for values in zip(*corners, strict=True))
    moved = []
    for lat_deg, lon_deg in corners:
        azimuth_deg, _, _ = EARTH.inv(middle_lon, middle_lat, lon_deg, lat_deg)
        lon_out, lat_out, _ = EARTH.fwd(lon_deg, lat_deg, azimuth_deg, distance_m)
        moved.append((float(lat_out), float(lon_out)))
    frame = HOME if entry.get("altitudeRelative", True) else AMSL
    return [_simple(WAYPOINT, frame, *place, height_m) for place in (*moved, moved[0])]


def _landing(entry: dict[str, Any]) -> list[Any]:
    approach = entry["landingApproachCoordinate" if "landingApproachCoordinate" in entry else "loiterCoordinate"]
    frame = HOME if entry.get("altitudesAreRelative", True) else AMSL
    places = ((WAYPOINT, approach), (LAND, entry["landCoordinate"]))
    return [_simple(command, frame, *(float(value) for value in place)) for command, place in places]


def _simple(command: int, frame: int, lat_deg: float, lon_deg: float, height_m: float) -> dict[str, Any]:
    params = [0, 0, 0, None, lat_deg, lon_deg, height_m]
    return {"type": "SimpleItem", "command": command, "frame": frame, "params": params}
