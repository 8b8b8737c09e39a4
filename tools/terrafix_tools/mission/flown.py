"""The course of a mission: what a vehicle flies to, of any command. What has no position does not matter."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from terrafix.core.errors import SourceError
from terrafix_tools.mission.commands import (
    FLOWN_TO,
    GLOBAL_INT,
    JUMP,
    JUMP_TAG,
    JUMP_TO_TAG,
    KNOWN,
    LANDS,
    LAST_NAV,
    LOCAL,
    METRIC,
    NEAR_HOME_DEG,
    RADIUS_PARAM,
    RETURN,
    SET_HOME,
    TAKE_OFFS,
)
from terrafix_tools.mission.items import AltitudeFrame, Do, Item

FRAMES = {
    0: AltitudeFrame.SEA,
    2: AltitudeFrame.HOME,  # MAV_FRAME_MISSION: the command has no position
    3: AltitudeFrame.HOME,
    5: AltitudeFrame.SEA,  # the _INT variants
    6: AltitudeFrame.HOME,
    10: AltitudeFrame.GROUND,
    11: AltitudeFrame.GROUND,
}
LOITERS = {17: Do.LOITER, 18: Do.LOITER_TURNS, 19: Do.LOITER_TIME}
HEIGHT_M = (-500.0, 9000.0)
DEGREES_MAX = 180.0
INT_SCALE = 1e-7  # degrees of a unit of MISSION_ITEM_INT
MOST_LISTED = 4  # items that a note lists

Place = tuple[float, float]  # latitude, longitude, degrees


@dataclass(frozen=True)
class Entry:
    """One item of a mission file. ``number``: for messages; ``sequence``: to which a jump refers; ``values``: param1 to
    4, latitude, longitude, height."""

    number: int
    sequence: int
    command: int
    frame: int
    values: list[float]


def flown_items(path: Path, home: Place, entries: Sequence[Entry]) -> tuple[list[Item], tuple[str, ...]]:
    """The items that a vehicle flies to, in order, and a line about each command or frame that is not known.

    A jump is the two legs that it adds. Raises SourceError: a position that is none, or in metres."""
    items: list[Item] = []
    sequences: list[int] = []
    unknown: dict[str, list[int]] = {}
    new_home: Place | None = None
    for entry in entries:
        if entry.command not in KNOWN:
            unknown.setdefault(f"MAVLink command {entry.command} is not known", []).append(entry.number)
        if entry.command == SET_HOME and entry.values[0] != 1.0:  # 1: the place of the vehicle
            new_home = _place(path, entry, home)
        added = _jumped(path, entry, entries, sequences, items) or _flown(path, entry, home, new_home)
        if added and entry.frame not in FRAMES and any(item.lat_deg is not None for item in added):
            unknown.setdefault(f"altitude frame {entry.frame} is not known; degrees are read", []).append(entry.number)
        items += added
        sequences += [entry.sequence] * len(added)
    return items, tuple(f"{text}: item {_listed(numbers)}" for text, numbers in unknown.items())


def _listed(numbers: list[int]) -> str:
    more = "" if len(numbers) <= MOST_LISTED else f" and {len(numbers) - MOST_LISTED} more"
    return ", ".join(map(str, numbers[:MOST_LISTED])) + more


def _flown(path: Path, entry: Entry, home: Place, new_home: Place | None) -> list[Item]:
    """The items of one entry: one that is flown to, or none."""
    command, values = entry.command, entry.values
    if command == RETURN:
        if new_home is None:
            return [Item(Do.RETURN, entry.number)]
        return [Item(Do.WAYPOINT, entry.number, *new_home)]
    if command in TAKE_OFFS:
        do = Do.TAKE_OFF
    elif command in FLOWN_TO or (command not in KNOWN and command <= LAST_NAV):
        do = Do.LAND if command in LANDS else LOITERS.get(command, Do.WAYPOINT)
    else:
        return []
    place = None if command in METRIC else _place(path, entry, home)
    if place is None and do is not Do.TAKE_OFF:
        return []  # "here": where the vehicle is
    height_m = values[6] if math.isfinite(values[6]) else 0.0
    check_position(f"{path} item {entry.number}", place, height_m)
    radius_m = values[RADIUS_PARAM[command]] if command in RADIUS_PARAM else 0.0
    if do is Do.WAYPOINT and command in RADIUS_PARAM:
        do = Do.LOITER_TURNS
    return [
        Item(
            do=do,
            number=entry.number,
            lat_deg=None if place is None else place[0],
            lon_deg=None if place is None else place[1],
            height_m=None if do is Do.LAND else height_m,
            altitude_frame=FRAMES.get(entry.frame, AltitudeFrame.SEA),
            radius_m=radius_m if math.isfinite(radius_m) else 0.0,
        )
    ]


def _jumped(path: Path, entry: Entry, entries: Sequence[Entry], sequences: list[int], items: list[Item]) -> list[Item]:
    """Of a jump back: its target, and again the item from which it was reached."""
    if entry.command == JUMP:
        wanted = entry.values[0]
    elif entry.command == JUMP_TO_TAG:
        tags = [e.sequence for e in entries if e.command == JUMP_TAG and e.values[0] == entry.values[0]]
        wanted = tags[0] if tags else math.nan
    else:
        return []
    placed = [i for i, item in enumerate(items) if item.lat_deg is not None]
    target = next((i for i in placed if sequences[i] >= wanted), None)
    if target is None or target == placed[-1]:
        return []
    return [replace(items[i], do=Do.WAYPOINT, number=entry.number, radius_m=0.0) for i in (target, placed[-1])]


def _place(path: Path, entry: Entry, home: Place) -> Place | None:
    """Position of an entry; None when it has none. Raises SourceError: it is in metres."""
    lat_deg, lon_deg = entry.values[4:6]
    if not (math.isfinite(lat_deg) and math.isfinite(lon_deg)) or (lat_deg, lon_deg) == (0.0, 0.0):
        return None
    if entry.frame in GLOBAL_INT and max(abs(lat_deg), abs(lon_deg)) > DEGREES_MAX:
        return lat_deg * INT_SCALE, lon_deg * INT_SCALE
    away_deg = max(abs(lat_deg - home[0]), abs(lon_deg - home[1]))
    if entry.frame in LOCAL and home != (0.0, 0.0) and away_deg > NEAR_HOME_DEG:
        raise SourceError(
            f"{path} item {entry.number}: its frame {entry.frame} counts metres from home, not degrees; write "
            "latitude and longitude (frame 0, 3 or 10)"
        )
    return lat_deg, lon_deg


def check_position(where: str, place: Place | None, height_m: float) -> None:
    """``place``: None without. Raises SourceError for a value out of range."""
    if place is not None and not (abs(place[0]) <= 90.0 and abs(place[1]) <= 180.0):
        raise SourceError(f"{where}: {place[0]:g}, {place[1]:g} is not a valid latitude and longitude")
    if not HEIGHT_M[0] <= height_m <= HEIGHT_M[1]:
        raise SourceError(f"{where}: a height of {height_m:g} m is out of {HEIGHT_M[0]:g} .. {HEIGHT_M[1]:g}")
