"""Mission files: plans of QGroundControl (.plan, .mission, JSON) and waypoint files (QGC WPL 110 and 120).

Formats: docs.qgroundcontrol.com "Plan file format"; mavlink.io "MAVLink plain-text file format". Command and frame
numbers: MAVLink common.xml, MAV_CMD and MAV_FRAME."""

import json
import math
import re
from pathlib import Path
from typing import Any

from terrafix.core.errors import OutputError, SourceError
from terrafix_tools.mission.flown import FRAMES, Entry, check_position, flown_items
from terrafix_tools.mission.items import POSITIONED, AltitudeFrame, Do, Item, Mission
from terrafix_tools.mission.plan_complex import simple_items
from terrafix_tools.text_file import read_text

HEADER = "QGC WPL 110"  # of a file that is written; its first row is home
HEADERS = re.compile(r"\s*QGC WPL (\S+)")
HOME_ROW, NO_HOME_ROW = "110", "120"  # versions of the format: 120 has no home, it is the list of QGroundControl
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
WAYPOINT = 16
# delays of payload, camera, gimbal: the vehicle does not move
STATIONARY_COMMANDS = {93, 201, 203, 205, 206, 530, 1000, 2000, 2001, 2500, 2501}
AMOUNT_MAX = 86_400.0  # more than a day of waiting, or as many turns, is an input error


def read_mission(path: Path, *, course_only: bool = False) -> Mission:
    """Reads a mission. ``course_only``: only the course matters, not how it is flown; then every command is read
    (`flown.py`), and what of it is not known is in the notes.

    Raises SourceError: not readable, unknown format, unsupported item.
    """
    try:
        text = read_text(path)
    except FileNotFoundError:
        raise SourceError(f"{path}: no such mission file; check --mission") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read as a mission ({error})") from None
    lines = text.splitlines()
    first = next((i for i, line in enumerate(lines) if line.partition("#")[0].strip()), 0)
    if lines and (header := HEADERS.match(lines[first])):
        home, entries = _waypoints(path, lines, first, header[1], allow_nan=course_only)
    elif text.lstrip().startswith("{"):
        home, entries = _plan(path, text)
    else:
        raise SourceError(
            f"{path}: neither a QGroundControl plan (JSON) nor a waypoint file ('{HEADER}' in its first line)"
        )
    if course_only:
        items, notes = flown_items(path, home, entries)
        return _mission(path, home, items, notes)
    return _mission(path, home, [item for item in map(lambda e: _item(path, e), entries) if item is not None], ())


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


def _waypoints(
    path: Path, lines: list[str], header: int, version: str, *, allow_nan: bool
) -> tuple[tuple[float, float], list[Entry]]:
    """Home and the items of a waypoint file; row 0 is home, but of version 120. Lines after a # are comments.
    ``header``: index of the line that names the format."""
    if version not in (HOME_ROW, NO_HOME_ROW):
        raise SourceError(f"{path}: a waypoint file of version {version}; save it as 'QGC WPL 110' or as a .plan")
    rows: list[list[float]] = []
    for line_number, line in enumerate(lines[header + 1 :], start=header + 2):
        cells = line.partition("#")[0].split()
        if not cells:
            continue
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            raise SourceError(f"{path} line {line_number}: '{line.strip()[:40]}' is not a row of numbers") from None
        must_be_numbers = row[:4] if allow_nan else row
        if not all(math.isfinite(value) for value in must_be_numbers) or math.inf in map(abs, row):
            raise SourceError(f"{path} line {line_number}: nan or inf is not allowed in a waypoint; write numbers")
        if len(row) != 12:
            raise SourceError(f"{path} line {line_number}: {len(row)} cells; a waypoint has 12")
        rows.append(row)
    has_home = version == HOME_ROW or (bool(rows) and rows[0][2:4] == [0.0, WAYPOINT])
    if len(rows) < 1 + has_home:
        raise SourceError(f"{path}: contains no mission; the first row is home, items follow it")
    entries = [Entry(int(row[0]), i, int(row[3]), int(row[2]), row[4:11]) for i, row in enumerate(rows)]
    if not has_home:
        return (0.0, 0.0), entries
    return (rows[0][8], rows[0][9]), entries[1:]


def _plan(path: Path, text: str) -> tuple[tuple[float, float], list[Entry]]:
    try:
        document = json.loads(text)
        mission = document.get("mission", document)  # a .mission is that object alone
        home, entries = mission.get("plannedHomePosition") or (0.0, 0.0), mission["items"]
        if isinstance(home, dict):  # a .mission
            home = home["coordinate"]
        place = float(home[0]), float(home[1])
        if not isinstance(entries, list) or not all(map(math.isfinite, place)):
            raise TypeError
    except (json.JSONDecodeError, RecursionError) as error:
        raise SourceError(f"{path}: not valid JSON ({error})") from None
    except (AttributeError, KeyError, TypeError, IndexError, ValueError, OverflowError):
        raise SourceError(
            f"{path}: not a QGroundControl plan: mission, plannedHomePosition or items is missing"
        ) from None
    items: list[Entry] = []
    for number, entry in enumerate(entries, start=1):
        is_complex = isinstance(entry, dict) and entry.get("type") == "ComplexItem"
        parts = simple_items(f"{path} item {number}", entry) if is_complex else [entry]
        items += [_simple(path, number, part) for part in parts]
    return place, items


def _simple(path: Path, number: int, entry: Any) -> Entry:
    """An item of a plan, or of a .mission: there with its position beside four parameters."""
    kind = entry.get("type") if isinstance(entry, dict) else None
    if kind not in ("SimpleItem", "missionItem"):
        raise SourceError(f"{path} item {number}: '{kind}' is not supported; put waypoints in its place")
    try:
        given = entry["params"] if "params" in entry else [entry[f"param{i}"] for i in range(1, 5)]
        given = [*given, *entry["coordinate"]] if "coordinate" in entry and len(given) == 4 else given
        values = [math.nan if value is None else float(value) for value in given]
        command, frame = int(entry["command"]), int(entry["frame"])
        sequence = int(entry.get("doJumpId", number))
    except (KeyError, TypeError, ValueError, OverflowError):  # overflow: Infinity, or an integer beyond any float
        raise SourceError(f"{path} item {number}: command, frame or params is missing or not a number") from None
    if len(values) != 7:
        raise SourceError(f"{path} item {number}: {len(values)} params; a mission item has 7")
    return Entry(number, sequence, command, frame, values)


def _item(path: Path, entry: Entry) -> Item | None:
    """Returns the item, None for a command that does not move the vehicle. Raises SourceError."""
    where, command, frame = f"{path} item {entry.number}", entry.command, entry.frame
    if command in STATIONARY_COMMANDS:
        return None
    do = COMMANDS.get(command)
    if do is None:
        known = ", ".join(f"{n} {d}" for n, d in COMMANDS.items())
        raise SourceError(f"{where}: MAVLink command {command} is not supported; known: {known}")
    if frame not in FRAMES:
        raise SourceError(f"{where}: altitude frame {frame} is not supported; use 0 (AMSL), 3 (home) or 10 (terrain)")
    p = [0.0 if math.isnan(value) else value for value in entry.values]
    if not all(map(math.isfinite, p)):
        raise SourceError(f"{where}: inf is not allowed in a mission item; write numbers")
    lat_deg, lon_deg, height_m = p[4], p[5], p[6]
    has_position = (lat_deg, lon_deg) != (0.0, 0.0) and do not in (Do.RETURN, Do.SPEED, Do.ALTITUDE, Do.TAKE_OFF)
    amount = p[1] if do is Do.SPEED else p[0] if do in {*POSITIONED, Do.ALTITUDE} else 0.0
    _check_values(where, do, (lat_deg, lon_deg) if has_position else None, height_m, amount)
    has_height = do in {*POSITIONED, Do.TAKE_OFF, Do.ALTITUDE} or (do is Do.RETURN and height_m > 0.0)
    return Item(
        do=do,
        number=entry.number,
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
    if not 0.0 <= amount <= AMOUNT_MAX or (do is Do.SPEED and amount == 0.0):
        raise SourceError(
            f"{where}: {amount:g} is not a valid duration, number of turns or speed; write a positive number"
        )
    check_position(where, position_deg, height_m)


def _mission(path: Path, home: tuple[float, float], items: list[Item], notes: tuple[str, ...]) -> Mission:
    if not items:
        raise SourceError(f"{path}: contains no item that a vehicle can fly")
    lat_deg, lon_deg = home
    if home == (0.0, 0.0):  # a ground station that has not seen the vehicle writes zeros
        first = next((item for item in items if item.lat_deg is not None), None)
        if first is None or first.lat_deg is None or first.lon_deg is None:
            raise SourceError(
                f"{path}: neither home nor any item has a position; set the home position in the ground station, and "
                "save it again"
            )
        lat_deg, lon_deg = first.lat_deg, first.lon_deg
    return Mission(str(path), lat_deg, lon_deg, tuple(items), notes)
