"""Mission files: QGroundControl plans (.plan, JSON) and waypoint files (QGC WPL 110) of ArduPilot's ground stations.

Formats: docs.qgroundcontrol.com "Plan file format"; mavlink.io "MAVLink plain-text file format". Command and frame
numbers: MAVLink common.xml, MAV_CMD and MAV_FRAME."""

import json
import math
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError, SourceError
from terrafix_tools.mission.items import POSITIONED, AltitudeFrame, Do, Item, Mission
from terrafix_tools.mission.plan_complex import simple_items

HEADER = "QGC WPL 110"
COMMANDS = {
    16: Do.WAYPOINT,
    17: Do.LOITER,
    18: Do.LOITER_TURNS,
    19: Do.LOITER_TIME,
    20: Do.RETURN,
    21: Do.LAND,
    22: Do.TAKE_OFF,
    30: Do.ALTITUDE,
    178: Do.SPEED,
}
FRAMES = {
    0: AltitudeFrame.SEA,
    2: AltitudeFrame.HOME,  # MAV_FRAME_MISSION: the command has no position
    3: AltitudeFrame.HOME,
    5: AltitudeFrame.SEA,  # the _INT variants
    6: AltitudeFrame.HOME,
    10: AltitudeFrame.GROUND,
    11: AltitudeFrame.GROUND,
}
WAYPOINT, RETURN, TAKE_OFF, VTOL_TAKE_OFF = 16, 20, 22, 84
LAST_NAV_COMMAND = 95  # MAV_CMD_NAV_LAST: navigation commands up to it are flown to if they have a position
LAND_START = 189  # DO_LAND_START: start of a landing sequence; flown like a waypoint
REGION_OF_INTEREST = 80  # NAV_ROI: a point to look at, not flown to
# delays of payload, camera, gimbal: the vehicle does not move
STATIONARY_COMMANDS = {93, 201, 203, 205, 206, 530, 1000, 2000, 2001, 2500, 2501}
AMOUNT_MAX = 86_400.0  # more than a day of waiting, or as many turns, is an input error
HEIGHT_M = (-500.0, 9000.0)


def read_mission(path: Path, *, course_only: bool = False) -> Mission:
    """Reads a mission. ``course_only``: only the course matters, not how it is flown. An item that is not supported
    becomes a waypoint if it has a position, and is skipped otherwise.

    Raises SourceError: not readable, unknown format, unsupported item.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise SourceError(f"{path}: no such mission file; check --mission") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read as a mission ({error})") from None
    if text.startswith(HEADER):
        return _waypoints(path, text, course_only)
    if text.lstrip().startswith("{"):
        return _plan(path, text, course_only)
    raise SourceError(
        f"{path}: neither a QGroundControl plan (JSON) nor a waypoint file ('{HEADER}' in its first line)"
    )


def write_mission(path: Path, mission: Mission) -> None:
    """Writes a waypoint file for a ground station or an autopilot. Raises OutputError."""
    numbers = {do: number for number, do in COMMANDS.items()}
    frames = {AltitudeFrame.SEA: 0, AltitudeFrame.HOME: 3, AltitudeFrame.GROUND: 10}
    lines = [HEADER, _line(0, 1, 0, WAYPOINT, (0.0, 0.0, 0.0, 0.0), mission.home_lat_deg, mission.home_lon_deg, 0.0)]
    for i, item in enumerate(mission.items, start=1):
        amounts = (1.0, item.amount, -1.0, 0.0) if item.do is Do.SPEED else (item.amount, 0.0, item.radius_m, 0.0)
        place = item.lat_deg or 0.0, item.lon_deg or 0.0, item.height_m or 0.0
        lines.append(_line(i, 0, frames[item.altitude_frame], numbers[item.do], amounts, *place))
    try:
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another --out") from None


def _line(i: int, current: int, frame: int, command: int, params: tuple[float, ...], *place: float) -> str:
    lat_deg, lon_deg, height_m = place
    cells = [i, current, frame, command, *params, f"{lat_deg:.8f}", f"{lon_deg:.8f}", f"{height_m:.3f}", 1]
    return "\t".join(str(cell) for cell in cells)


def _waypoints(path: Path, text: str, course_only: bool) -> Mission:
    """Parses a waypoint file; row 0 is home."""
    rows: list[list[float]] = []
    for line_number, line in enumerate(text.splitlines()[1:], start=2):
        cells = line.split()
        if not cells:
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            raise SourceError(f"{path} line {line_number}: '{line.strip()[:40]}' is not a row of numbers") from None
        if not all(math.isfinite(value) for value in row):
            raise SourceError(f"{path} line {line_number}: nan or inf is not allowed in a waypoint; write numbers")
        if len(row) != 12:
            raise SourceError(f"{path} line {line_number}: {len(row)} cells; a waypoint has 12")
        rows.append(row)
    if len(rows) < 2:
        raise SourceError(f"{path}: contains no mission; the first row is home, items follow it")
    read = _course_item if course_only else _item
    items = [read(path, int(row[0]), int(row[3]), int(row[2]), row[4:11]) for row in rows[1:]]
    return _mission(path, (rows[0][8], rows[0][9]), items)


def _plan(path: Path, text: str, course_only: bool) -> Mission:
    try:
        mission = json.loads(text)["mission"]
        home, entries = mission["plannedHomePosition"], mission["items"]
        place = float(home[0]), float(home[1])
        if not isinstance(entries, list) or not all(map(math.isfinite, place)):
            raise TypeError
    except (json.JSONDecodeError, RecursionError) as error:
        raise SourceError(f"{path}: not valid JSON ({error})") from None
    except (KeyError, TypeError, IndexError, ValueError, OverflowError):
        raise SourceError(
            f"{path}: not a QGroundControl plan: mission, plannedHomePosition or items is missing"
        ) from None
    items = []
    for number, entry in enumerate(entries, start=1):
        is_complex = isinstance(entry, dict) and entry.get("type") == "ComplexItem"
        parts = simple_items(f"{path} item {number}", entry) if is_complex else [entry]
        items += [_simple(path, number, part, course_only) for part in parts]
    return _mission(path, place, items)


def _simple(path: Path, number: int, entry: Any, course_only: bool) -> Item | None:
    kind = entry.get("type") if isinstance(entry, dict) else None
    if kind != "SimpleItem":
        raise SourceError(f"{path} item {number}: '{kind}' is not supported; put waypoints in its place")
    try:
        values = [math.nan if value is None else float(value) for value in entry["params"]]
        command, frame = int(entry["command"]), int(entry["frame"])
    except (KeyError, TypeError, ValueError, OverflowError):  # overflow: Infinity, or an integer beyond any float
        raise SourceError(f"{path} item {number}: command, frame or params is missing or not a number") from None
    if len(values) != 7:
        raise SourceError(f"{path} item {number}: {len(values)} params; a mission item has 7")
    return (_course_item if course_only else _item)(path, number, command, frame, values)


def _item(path: Path, number: int, command: int, frame: int, values: list[float]) -> Item | None:
    """Returns the item, None for a command that does not move the vehicle. ``values``: param1 to 4, latitude,
    longitude, height. Raises SourceError.
    """
    where = f"{path} item {number}"
    if command in STATIONARY_COMMANDS:
        return None
    do = COMMANDS.get(command)
    if do is None:
        known = ", ".join(f"{n} {d}" for n, d in COMMANDS.items())
        raise SourceError(f"{where}: MAVLink command {command} is not supported; known: {known}")
    if frame not in FRAMES:
        raise SourceError(f"{where}: altitude frame {frame} is not supported; use 0 (AMSL), 3 (home) or 10 (terrain)")
    p = [0.0 if math.isnan(value) else value for value in values]
    if not all(map(math.isfinite, p)):
        raise SourceError(f"{where}: inf is not allowed in a mission item; write numbers")
    lat_deg, lon_deg, height_m = p[4], p[5], p[6]
    has_position = (lat_deg, lon_deg) != (0.0, 0.0) and do not in (Do.RETURN, Do.SPEED, Do.ALTITUDE, Do.TAKE_OFF)
    amount = p[1] if do is Do.SPEED else p[0] if do in {*POSITIONED, Do.ALTITUDE} else 0.0
    _check_values(where, do, (lat_deg, lon_deg) if has_position else None, height_m, amount)
    has_height = do in {*POSITIONED, Do.TAKE_OFF, Do.ALTITUDE} or (do is Do.RETURN and height_m > 0.0)
    return Item(
        do=do,
        number=number,
        lat_deg=lat_deg if has_position else None,
        lon_deg=lon_deg if has_position else None,
        height_m=height_m if has_height else None,
        altitude_frame=FRAMES[frame],
        amount=amount,
        radius_m=p[2] if do in (Do.LOITER, Do.LOITER_TURNS, Do.LOITER_TIME) else 0.0,
    )


def _check_values(where: str, do: Do, position_deg: tuple[float, float] | None, height_m: float, amount: float) -> None:
    """``position_deg``: latitude and longitude, None without. Raises SourceError for a value out of range."""
    if do in POSITIONED and position_deg is None:
        raise SourceError(f"{where}: a {do} needs latitude and longitude")
    if position_deg is not None and not (abs(position_deg[0]) <= 90.0 and abs(position_deg[1]) <= 180.0):
        raise SourceError(f"{where}: {position_deg[0]:g}, {position_deg[1]:g} is not a valid latitude and longitude")
    if not 0.0 <= amount <= AMOUNT_MAX or (do is Do.SPEED and amount == 0.0):
        raise SourceError(
            f"{where}: {amount:g} is not a valid duration, number of turns or speed; write a positive number"
        )
    if not HEIGHT_M[0] <= height_m <= HEIGHT_M[1]:
        raise SourceError(f"{where}: a height of {height_m:g} m is out of {HEIGHT_M[0]:g} .. {HEIGHT_M[1]:g}")


def _course_item(path: Path, number: int, command: int, frame: int, values: list[float]) -> Item | None:
    """Returns the item reduced to its position; None when it has none, or when the vehicle does not fly to it."""
    if command == VTOL_TAKE_OFF:
        command = TAKE_OFF
    has_position = all(map(math.isfinite, values[4:6])) and (values[4], values[5]) != (0.0, 0.0)
    flyable = (
        command <= LAST_NAV_COMMAND and command not in (REGION_OF_INTEREST, *STATIONARY_COMMANDS)
    ) or command == LAND_START
    if command not in (TAKE_OFF, RETURN) and not (has_position and flyable):
        return None
    known = command in COMMANDS and frame in FRAMES
    return _item(path, number, command if known else WAYPOINT, frame if known else 0, values)


def _mission(path: Path, home: tuple[float, float], items: list[Item | None]) -> Mission:
    flyable = tuple(item for item in items if item is not None)
    if not flyable:
        raise SourceError(f"{path}: contains no item that a vehicle can fly")
    lat_deg, lon_deg = home
    if home == (0.0, 0.0):  # a ground station that has not seen the vehicle writes zeros
        first = next((item for item in flyable if item.lat_deg is not None), None)
        if first is None or first.lat_deg is None or first.lon_deg is None:
            raise SourceError(f"{path}: neither home nor any item has a position")
        lat_deg, lon_deg = first.lat_deg, first.lon_deg
    return Mission(str(path), lat_deg, lon_deg, flyable)
