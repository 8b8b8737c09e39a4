"""Shared by the tests of vehicles and sensors: a place, missions over it, flights of them."""

import math

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix_tools.mission.mission import Above, Do, Item, Mission
from terrafix_tools.sim.interfaces import Navigation, State, Vehicle, navigation_of

PLACE = LocalFrame(48.0, 11.0)
STEP_S = 0.02
HOME = (100.0, -50.0)  # east, north


def flat(e_m: float, n_m: float) -> float:
    return 400.0


def hills(e_m: float, n_m: float) -> float:
    return 400.0 + 20.0 * math.sin(e_m / 300.0) + 10.0 * math.cos(n_m / 200.0)


def at(do: Do, e_m: float, n_m: float, height_m: float = 100.0, *, above: Above = Above.HOME, **more: float) -> Item:
    lat_deg, lon_deg = PLACE.to_wgs84(e_m, n_m)
    return Item(do, 0, lat_deg, lon_deg, height_m, above, **more)


def mission(*items: Item) -> Mission:
    return Mission("test", *PLACE.to_wgs84(*HOME), items)


def fly(vehicle: Vehicle, first: State, seconds: float, offset_m: np.ndarray | None = None) -> list[State]:
    """States at each step, the first one too. ``offset_m``: error of the position that the vehicle is told."""
    states = [first]
    for _ in range(round(seconds / STEP_S)):
        told: Navigation | None = None
        if offset_m is not None:
            told = navigation_of(states[-1])
            told = Navigation(
                told.p_b_in_w_m + offset_m,
                told.velocity_enu_mps,
                told.yaw_rad,
                told.pitch_rad,
                told.roll_rad,
                told.airspeed_mps,
            )
        states.append(vehicle.step(STEP_S, told))
    return states


def positions(states: list[State]) -> np.ndarray:
    """(N, 3)"""
    return np.array([s.p_b_in_w_m for s in states])
