"""A new flight and its images from files, for `terrafix flight`."""

import re
from pathlib import Path
from typing import Any

import msgspec
from pydantic import BaseModel, ValidationError

from terrafix.core.errors import SourceError, UsageError
from terrafix.vision.sources.description import Description, read_description
from terrafix.vision.sources.images import image_files
from terrafix_tools.console.payloads import Camera, Mount, NewFlight, Telemetry
from terrafix_tools.console.store.flights import order_of
from terrafix_tools.mission.file import read_mission

HEADER_CELL = "file"


def new_flight(
    description: Path, map_name: str, mission: Path | None, corridor_m: float, height_m: float | None, name: str
) -> NewFlight:
    """Raises UsageError, SourceError."""
    if bool(map_name) == (mission is not None):
        raise UsageError("give either --map or --mission")
    read = read_description(description)
    if read.camera is None:
        raise SourceError(f"{description}: there is no [camera]; add one with width, height, fx, fy, cx, cy in pixels")
    if read.camera.model != "pinhole":
        raise SourceError(f"{description}: camera.model {read.camera.model}: the console takes pinhole cameras only")
    given = {
        "name": name or read.name,
        "camera": _taken(read.camera, Camera),
        "mount": _taken(read.mount, Mount),
        "telemetry": _taken(read.telemetry, Telemetry),
        "start": _start(read),
        "map": map_name or None,
        "area": None if mission is None else {"waypoints": _waypoints(mission), "corridor_m": corridor_m},
        "height_m": height_m,
    }
    try:
        return NewFlight.model_validate(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise SourceError(f"{description}: {'.'.join(map(str, first['loc']))}: {first['msg']}") from None


def _start(read: Description) -> dict[str, float | None] | None:
    start = read.start
    if start is None:
        return None
    ground_m = start.ground_amsl_m if start.ground_amsl_m is not None else start.alt_amsl_m
    return {"lat": start.lat_deg, "lon": start.lon_deg, "sigma_m": start.sigma_m, "ground_amsl_m": ground_m}


def _waypoints(mission: Path) -> list[dict[str, float]]:
    read = read_mission(mission, course_only=True)
    placed = [(i.lat_deg, i.lon_deg) for i in read.items if i.lat_deg is not None and i.lon_deg is not None]
    home = (read.home_lat_deg, read.home_lon_deg)
    return [{"lat": lat, "lon": lon} for lat, lon in ([home] if home != (0.0, 0.0) else []) + placed]


def images_of(folder: Path) -> list[tuple[str, Path]]:
    """Names and files of the images of a folder, in the order of their names. Raises SourceError."""
    try:
        paths = image_files(folder)
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read ({error.strerror})") from None
    return sorted(((path.name, path) for path in paths), key=lambda image: order_of(image[0]))


def telemetry_of(table: Path, images: list[tuple[str, Path]]) -> dict[str, str]:
    """The rows of a frames.csv by the name under which an image is sent, its header below "". Raises SourceError."""
    try:
        lines = [line for line in table.read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{table}: cannot be read ({error})") from None
    if not lines or not re.match(rf"{HEADER_CELL}\s*,", lines[0]):
        raise SourceError(f"{table}: its first column is not '{HEADER_CELL}'; docs/flight-folder.md has the columns")
    rows = {line.partition(",")[0].strip(): line.partition(",")[2] for line in lines[1:]}
    missing = next((path.name for _, path in images if path.name not in rows), None)
    if missing is not None:
        raise SourceError(f"{table}: has no row for {missing}")
    return {"": lines[0], **{name: f"{name},{rows[path.name]}" for name, path in images}}


def _taken(table: msgspec.Struct, body: type[BaseModel]) -> dict[str, Any]:
    """What images alone need of a table of the description."""
    return {key: value for key, value in msgspec.to_builtins(table).items() if key in body.model_fields}
