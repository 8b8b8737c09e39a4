"""A mission: what a vehicle is to do, item by item, in WGS84; and the same in the local frame of a flight."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from terrafix.core.errors import SourceError
from terrafix.core.geodesy import LocalFrame

HeightOf = Callable[[float, float], float]  # (e_m, n_m) -> ground, metres AMSL


class Do(StrEnum):
    TAKE_OFF = "take off"
    WAYPOINT = "waypoint"
    LOITER = "loiter"  # until the end of the flight
    LOITER_TURNS = "loiter turns"
    LOITER_TIME = "loiter time"
    ALTITUDE = "change altitude"  # keep the course until the height is reached
    SPEED = "change speed"
    LAND = "land"
    RETURN = "return to launch"


class Above(StrEnum):
    """What a height counts from."""

    SEA = "sea level"
    HOME = "home"
    GROUND = "the ground below"


PLACED = {Do.WAYPOINT, Do.LOITER, Do.LOITER_TURNS, Do.LOITER_TIME}  # items that must say where

CLEARANCE_M = 5.0  # between a waypoint and the ground


@dataclass(frozen=True)
class Item:
    """One thing to do. ``number`` is its place in the file, for messages."""

    do: Do
    number: int = 0
    lat_deg: float | None = None  # None: where the vehicle is then
    lon_deg: float | None = None
    height_m: float | None = None  # None: as before
    above: Above = Above.HOME
    amount: float = 0.0  # seconds (WAYPOINT: hold, LOITER_TIME), turns (LOITER_TURNS) or m/s (SPEED)
    radius_m: float = 0.0  # of a loiter; negative: counter-clockwise; 0: the vehicle's own


@dataclass(frozen=True)
class Mission:
    """``name`` names the file, or says that it was generated; home is where the vehicle stands at the start."""

    name: str
    home_lat_deg: float
    home_lon_deg: float
    items: tuple[Item, ...]

    def starts_on_ground(self) -> bool:
        """With a take-off the vehicle stands at home; without one it begins in the air at the first waypoint."""
        return self.items[0].do is Do.TAKE_OFF


@dataclass(frozen=True)
class Target:
    """An item in the local frame of a flight."""

    do: Do
    e_m: float  # nan: where the vehicle is then
    n_m: float
    height_m: float  # nan: as before
    over_ground: bool  # ``height_m`` counts from the ground below; otherwise AMSL
    amount: float
    radius_m: float

    def up_m(self, ground_amsl_m: float) -> float:
        """Wanted height AMSL over ground of this height; nan: as before."""
        return self.height_m + ground_amsl_m if self.over_ground else self.height_m


@dataclass(frozen=True)
class Box:
    """A world's bounds in the local frame, metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    def holds(self, e_m: float, n_m: float) -> bool:
        return self.west_m <= e_m <= self.east_m and self.south_m <= n_m <= self.north_m

    def shrunk(self, margin_m: float) -> "Box":
        return Box(self.west_m + margin_m, self.south_m + margin_m, self.east_m - margin_m, self.north_m - margin_m)


def targets(mission: Mission, frame: LocalFrame, height: HeightOf) -> list[Target]:
    """The mission in ``frame``; heights over home become AMSL over the ground at home.

    Raises SourceError: a place too near to the ground below it, or in it."""
    home_amsl_m = height(*frame.to_local(mission.home_lat_deg, mission.home_lon_deg))
    made = []
    for item in mission.items:
        e_m, n_m = math.nan, math.nan
        if item.lat_deg is not None and item.lon_deg is not None:
            e_m, n_m = frame.to_local(item.lat_deg, item.lon_deg)
        elif item.do is Do.RETURN:
            e_m, n_m = frame.to_local(mission.home_lat_deg, mission.home_lon_deg)
        height_m = math.nan if item.height_m is None else item.height_m
        if item.above is Above.HOME:
            height_m += home_amsl_m
        target = Target(item.do, e_m, n_m, height_m, item.above is Above.GROUND, item.amount, item.radius_m)
        if item.do in PLACED and not math.isnan(height_m):
            ground_m = height(e_m, n_m)
            if (over_m := target.up_m(ground_m) - ground_m) < CLEARANCE_M:
                where = f"{over_m:.0f} m over" if over_m >= 0.0 else f"{-over_m:.0f} m in"
                raise SourceError(f"{mission.name}: item {item.number} ({item.do}) is {where} the ground; raise it")
        made.append(target)
    return made


def check(mission: Mission, frame: LocalFrame, bounds: Box) -> None:
    """Raises SourceError when the mission has nothing to fly, or leaves ``bounds``."""
    if not any(item.do in PLACED for item in mission.items):
        raise SourceError(f"{mission.name}: there is no waypoint in it; a mission needs one at least")
    places = [("home", mission.home_lat_deg, mission.home_lon_deg)]
    places += [
        (f"item {item.number} ({item.do})", item.lat_deg, item.lon_deg)
        for item in mission.items
        if item.lat_deg is not None and item.lon_deg is not None
    ]
    for what, lat_deg, lon_deg in places:
        e_m, n_m = frame.to_local(lat_deg, lon_deg)
        if not bounds.holds(e_m, n_m):
            out_m = max(bounds.west_m - e_m, e_m - bounds.east_m, bounds.south_m - n_m, n_m - bounds.north_m)
            raise SourceError(
                f"{mission.name}: {what} at {lat_deg:.6f}, {lon_deg:.6f} lies {out_m:.0f} m outside the world; "
                "move it, or give a larger image"
            )
