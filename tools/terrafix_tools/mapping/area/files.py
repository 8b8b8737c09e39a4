"""Reads the area of a map: a box, KML, GeoJSON, or a ground station mission, with a buffer around it.

Formats: GeoJSON (RFC 7946); KML as in `kml.py`, missions as in `mission/file.py`."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.core.errors import SourceError, UsageError
from terrafix_tools.mapping.area.buffer import around_line, around_ring
from terrafix_tools.mapping.area.checks import check_points, check_ring
from terrafix_tools.mapping.area.kml import SUFFIXES as KML
from terrafix_tools.mapping.area.kml import kml_shapes
from terrafix_tools.mapping.area.polygons import Area
from terrafix_tools.mission.file import read_mission
from terrafix_tools.text_file import decode_text

DEFAULT_BUFFER_KM = 20.0  # allows for a vehicle that arrives from anywhere or is blown off its path
MISSIONS = (".plan", ".waypoints", ".mission", ".txt")
BOX = re.compile(r"\s*" + r"\s*,\s*".join([r"([-+]?[\d.]+(?:[eE][-+]?\d+)?)"] * 4) + r"\s*")
KNOWN = "a box W,S,E,N in degrees, a .kml or .kmz, a .geojson, a QGroundControl .plan or an ArduPilot waypoint file"

Outline = tuple[bool, np.ndarray]  # (polygon, else line; (n, 2) lon, lat)


def read_area(text: str, *, buffer_km: float | None = None, corridor_km: float | None = None) -> Area:
    """The area of ``text``: W,S,E,N or a file.

    ``buffer_km``: distance around all of it, default DEFAULT_BUFFER_KM; ``corridor_km``: the same for a mission or a
    line, an error for anything else.
    Raises UsageError, and SourceError for a mission that cannot be read."""
    if buffer_km is not None and corridor_km is not None:
        raise UsageError("--buffer and --corridor exclude each other: a corridor is the buffer of a line")
    for option, value in (("--buffer", buffer_km), ("--corridor", corridor_km)):
        if value is not None and not 0.0 <= value <= 200.0:
            raise UsageError(f"{option} {value:g}: give kilometres between 0 and 200")
    outlines, notes = _read(text)
    if corridor_km is not None and all(closed for closed, _ in outlines):
        raise UsageError(f"{text}: neither a mission nor a line, which --corridor needs; give --buffer")
    distance_m = 1000.0 * next(v for v in (corridor_km, buffer_km, DEFAULT_BUFFER_KM) if v is not None)
    rings: list[np.ndarray] = []
    for closed, points in outlines:
        if not closed and distance_m <= 0.0:
            raise UsageError(f"{text}: a line without width is no area; give --corridor KM, for example 2")
        rings += around_ring(points, distance_m) if closed else around_line(points, distance_m)
    return Area(_name(text), tuple(rings), notes)


def is_line(text: str) -> bool:
    """True when the text names a mission or a line, for which a corridor is possible. Raises as `read_area`."""
    return not all(closed for closed, _ in _read(text)[0])


def _name(text: str) -> str:
    return f"box {text}" if BOX.fullmatch(text) else Path(text).name


def _read(text: str) -> tuple[list[Outline], tuple[str, ...]]:
    """The outlines, and notes about the file."""
    box = BOX.fullmatch(text)
    if box:
        return [(True, _box(text, *(float(v) for v in box.groups())))], ()
    path = Path(text)
    suffix = path.suffix.lower()
    if suffix not in (*KML, ".geojson", ".json", *MISSIONS):
        raise UsageError(f"--area {text}: give {KNOWN}")
    if suffix in MISSIONS:
        return _mission(path)
    notes: tuple[str, ...] = ()
    try:
        data = path.read_bytes()
        if suffix in KML:
            shapes, notes = kml_shapes(path, data)
            outlines = [
                _outline(f"{path} {kind} {i}", closed, points) for i, (closed, kind, points) in enumerate(shapes, 1)
            ]
        else:
            outlines = _geojson(path, decode_text(data))
    except FileNotFoundError:
        raise UsageError(f"{path}: no such file; check --area") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read as an area ({error}); save it as text in UTF-8") from None
    if not outlines:
        raise UsageError(f"{path}: contains no polygon and no line; draw the area as a polygon and save it again")
    return outlines, notes


def _box(text: str, west: float, south: float, east: float, north: float) -> np.ndarray:
    corners = np.array([[west, south], [east, south], [east, north], [west, north]])
    check_points(f"--area {text}", corners[[0, 2]])
    if west > east:
        raise UsageError(f"--area {text}: west is east of east; over the antimeridian make one map for each side")
    if west == east or south >= north:
        raise UsageError(f"--area {text}: an empty box; write it as west,south,east,north in degrees")
    return corners


def _mission(path: Path) -> tuple[list[Outline], tuple[str, ...]]:
    """Home and every position of a mission in order, (n, 2) lon, lat."""
    mission = read_mission(path, course_only=True)
    placed = [(i.lon_deg, i.lat_deg) for i in mission.items if i.lon_deg is not None and i.lat_deg is not None]
    home = (mission.home_lon_deg, mission.home_lat_deg)
    points = np.array([*([home] if home != (0.0, 0.0) else []), *placed], float).reshape(-1, 2)
    if not len(points):
        raise SourceError(f"{path}: no item of this mission has a position; a map needs at least one")
    check_points(str(path), points)
    return [(False, points)], mission.notes


def _geojson(path: Path, content: str) -> list[Outline]:
    try:
        document = json.loads(content)
    except (json.JSONDecodeError, RecursionError) as error:
        raise UsageError(f"{path}: not valid JSON ({error}); export the area again") from None
    if isinstance(document, dict) and document.get("fileType") == "Plan":
        raise UsageError(f"{path}: a QGroundControl plan; name it .plan, so that it is read as a mission")
    outlines: list[Outline] = []
    for kind, coordinates in _geometries(path, document):
        where = f"{path} {kind} {len(outlines) + 1}"
        try:
            points = np.array([point[:2] for point in coordinates], float).reshape(-1, 2)
        except (TypeError, ValueError, IndexError, KeyError):
            raise UsageError(f"{where}: its coordinates are no list of [longitude, latitude]") from None
        outlines.append(_outline(where, kind == "Polygon", points))
    return outlines


def _geometries(path: Path, node: Any) -> list[tuple[str, Any]]:
    """Outer rings and lines: ("Polygon" or "LineString", coordinates). Points have no area and are ignored."""
    kind = node.get("type") if isinstance(node, dict) else None
    inner = {"FeatureCollection": "features", "GeometryCollection": "geometries", "Feature": "geometry"}.get(str(kind))
    if inner:
        children = node.get(inner)
        if kind == "Feature":
            children = [] if children is None else [children]
        if not isinstance(children, list):
            raise UsageError(f"{path}: a {kind} without {inner}; export the area again")
        return [found for child in children for found in _geometries(path, child)]
    coordinates = node.get("coordinates") if isinstance(node, dict) else None
    if kind in ("Point", "MultiPoint"):
        return []
    if not isinstance(coordinates, list):
        raise UsageError(f"{path}: not GeoJSON (an object of type '{kind}'); give a Polygon, a Feature or a collection")
    return _rings_and_lines(path, str(kind), coordinates)


def _rings_and_lines(path: Path, kind: str, coordinates: list[Any]) -> list[tuple[str, Any]]:
    """Outer rings and lines of one geometry. Raises UsageError: another type."""
    match kind:
        case "Polygon":
            return [("Polygon", coordinates[0] if coordinates else [])]
        case "MultiPolygon":
            return [("Polygon", rings[0] if isinstance(rings, list) and rings else []) for rings in coordinates]
        case "LineString":
            return [("LineString", coordinates)]
        case "MultiLineString":
            return [("LineString", line) for line in coordinates]
    raise UsageError(f"{path}: GeoJSON of type '{kind}' is not an area; give a Polygon, a Feature or a collection")


def _outline(where: str, closed: bool, points: np.ndarray) -> Outline:
    if closed:
        return True, check_ring(where, points)
    check_points(where, points)
    return False, points
