"""Rig of the tests of simulated vehicles and sensors: a place, missions there, and their simulation."""

import math
from dataclasses import replace

import numpy as np

from terrafix.core.geodesy import LocalFrame
from terrafix_lab.sim.flights.path import STEP_S, states_of
from terrafix_lab.sim.interfaces import Navigation, State, Vehicle, navigation_of
from terrafix_tools.mission.items import AltitudeFrame, Do, Item, Mission

PLACE = LocalFrame(48.0, 11.0)
HOME = (100.0, -50.0)  # east, north


def flat(e_m: float, n_m: float) -> float:
    """-> terrain height [m AMSL]."""
    return 400.0


def hills(e_m: float, n_m: float) -> float:
    return 400.0 + 20.0 * math.sin(e_m / 300.0) + 10.0 * math.cos(n_m / 200.0)


def at(
    do: Do,
    e_m: float,
    n_m: float,
    height_m: float = 100.0,
    *,
    altitude_frame: AltitudeFrame = AltitudeFrame.HOME,
    **more: float,
) -> Item:
    """-> mission item at a local position."""
    lat_deg, lon_deg = PLACE.to_wgs84(e_m, n_m)
    return Item(do, 0, lat_deg, lon_deg, height_m, altitude_frame, **more)


def mission(*items: Item) -> Mission:
    return Mission("test", *PLACE.to_wgs84(*HOME), items)


def fly(vehicle: Vehicle, seconds: float, offset_m: np.ndarray | None = None) -> list[State]:
    """-> the states of all steps, with that of now. ``offset_m``: (3,) error of the position that the vehicle's
    controller gets; None: it gets the true state."""

    def navigation(state: State) -> Navigation | None:
        if offset_m is None:
            return None
        true = navigation_of(state)
        return replace(true, p_b_in_w_m=true.p_b_in_w_m + offset_m)

    return list(states_of(vehicle, round(seconds / STEP_S) + 1, navigation))


def positions(states: list[State]) -> np.ndarray:
    """(N, 3)"""
    return np.array([s.p_b_in_w_m for s in states])
