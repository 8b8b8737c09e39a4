"""Mission items in WGS84, and their targets in the local frame of a flight."""

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


class AltitudeFrame(StrEnum):
    """Reference of a height."""

    SEA = "sea level"
    HOME = "home"
    GROUND = "the ground below"


POSITIONED = {Do.WAYPOINT, Do.LOITER, Do.LOITER_TURNS, Do.LOITER_TIME}  # items that require a position

CLEARANCE_M = 5.0  # least height of a waypoint over the ground


@dataclass(frozen=True)
class Item:
    """One mission item. ``number`` is its index in the file, for messages."""

    do: Do
    number: int = 0
    lat_deg: float | None = None  # None: current position of the vehicle
    lon_deg: float | None = None
    height_m: float | None = None  # None: unchanged
    altitude_frame: AltitudeFrame = AltitudeFrame.HOME
    amount: float = 0.0  # seconds (WAYPOINT: hold, LOITER_TIME), turns (LOITER_TURNS) or m/s (SPEED)
    radius_m: float = 0.0  # of a loiter; negative: counter-clockwise; 0: the vehicle's default


@dataclass(frozen=True)
class Mission:
    """``name``: the file, or a description of a generated mission. Home is the position of the vehicle at the start.
    ``notes``: what of the file was assumed or left out, a line each."""

    name: str
    home_lat_deg: float
    home_lon_deg: float
    items: tuple[Item, ...]
    notes: tuple[str, ...] = ()

    def starts_on_ground(self) -> bool:
        """True when the mission begins with a take-off from home; otherwise it begins in the air at the first
        waypoint.
        """
        return self.items[0].do is Do.TAKE_OFF


@dataclass(frozen=True)
class Target:
    """A mission item in the local frame of a flight."""

    do: Do
    e_m: float  # nan: current position
    n_m: float
    height_m: float  # nan: unchanged
    over_ground: bool  # ``height_m`` is above the ground below; otherwise AMSL
    amount: float
    radius_m: float

    def up_m(self, ground_amsl_m: float) -> float:
        """Returns the target height AMSL over ground of this height; nan: unchanged."""
        return self.height_m + ground_amsl_m if self.over_ground else self.height_m


@dataclass(frozen=True)
class Box:
    """Bounds of a world in the local frame, metres."""

    west_m: float
    south_m: float
    east_m: float
    north_m: float

    def contains(self, e_m: float, n_m: float) -> bool:
        return self.west_m <= e_m <= self.east_m and self.south_m <= n_m <= self.north_m

    def shrunk(self, margin_m: float) -> "Box":
        return Box(self.west_m + margin_m, self.south_m + margin_m, self.east_m - margin_m, self.north_m - margin_m)


def targets(mission: Mission, frame: LocalFrame, height: HeightOf) -> list[Target]:
    """Converts the mission to ``frame``; heights above home become AMSL, with the ground height at home.

    Raises SourceError when a position is less than CLEARANCE_M above the ground.
    """
    home_amsl_m = height(*frame.to_local(mission.home_lat_deg, mission.home_lon_deg))
    converted = []
    for item in mission.items:
        e_m, n_m = math.nan, math.nan
        if item.lat_deg is not None and item.lon_deg is not None:
            e_m, n_m = frame.to_local(item.lat_deg, item.lon_deg)
        elif item.do is Do.RETURN:
            e_m, n_m = frame.to_local(mission.home_lat_deg, mission.home_lon_deg)
        height_m = math.nan if item.height_m is None else item.height_m
        if item.altitude_frame is AltitudeFrame.HOME:
            height_m += home_amsl_m
        target = Target(
            item.do, e_m, n_m, height_m, item.altitude_frame is AltitudeFrame.GROUND, item.amount, item.radius_m
        )
        if item.do in POSITIONED and not math.isnan(height_m):
            ground_m = height(e_m, n_m)
            if (over_m := target.up_m(ground_m) - ground_m) < CLEARANCE_M:
                where = f"{over_m:.0f} m over" if over_m >= 0.0 else f"{-over_m:.0f} m in"
                raise SourceError(f"{mission.name}: item {item.number} ({item.do}) is {where} the ground; raise it")
        converted.append(target)
    return converted


def check(mission: Mission, frame: LocalFrame, bounds: Box) -> None:
    """Raises SourceError when the mission has no waypoint, or leaves ``bounds``."""
    if not any(item.do in POSITIONED for item in mission.items):
        raise SourceError(f"{mission.name}: no waypoint; a mission needs at least one")
    places = [("home", mission.home_lat_deg, mission.home_lon_deg)]
    places += [
        (f"item {item.number} ({item.do})", item.lat_deg, item.lon_deg)
        for item in mission.items
        if item.lat_deg is not None and item.lon_deg is not None
    ]
    for what, lat_deg, lon_deg in places:
        e_m, n_m = frame.to_local(lat_deg, lon_deg)
        if not bounds.contains(e_m, n_m):
            out_m = max(bounds.west_m - e_m, e_m - bounds.east_m, bounds.south_m - n_m, n_m - bounds.north_m)
            raise SourceError(
                f"{mission.name}: {what} at {lat_deg:.6f}, {lon_deg:.6f} lies {out_m:.0f} m outside the world; "
                "move it, or give a larger image"
            )
