"""Rates and forces are consistent with the motion: an independent strapdown integration gives the trajectory."""

import cv2
import numpy as np
import pytest

from terrafix.core.geodesy import rot_w_b
from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.vehicle.copter import Copter
from terrafix_lab.sim.vehicle.plane import Plane
from terrafix_tools.mission.items import Do, Item, Mission
from vehicle_missions import HOME, PLACE, STEP_S, at, fly, hills, mission, positions

GRAVITY_ENU_MPS2 = np.array([0.0, 0.0, -9.80665])
SECONDS = 60.0
IN_THE_AIR = mission(
    at(Do.WAYPOINT, *HOME),
    at(Do.WAYPOINT, 500.0, 250.0),
    at(Do.WAYPOINT, 100.0, 600.0, 130.0),
    at(Do.WAYPOINT, -300.0, 0.0),
)
FROM_THE_GROUND = mission(Item(Do.TAKE_OFF, height_m=60.0), *IN_THE_AIR.items[1:])


def strapdown(states: list[State]) -> np.ndarray:
    """Dead reckoning on rates and forces alone, from the first state: (N, 3). Rotation matrices, midpoint rule."""
    first = states[0]
    r, v, p = first.r_w_b(), first.velocity_enu_mps.copy(), first.p_b_in_w_m.copy()
    track = [p]
    for state in states[1:]:
        turn = state.rates_b_radps * STEP_S
        half = r @ cv2.Rodrigues(0.5 * turn)[0]
        a = half @ state.force_b_mps2 + GRAVITY_ENU_MPS2
        p = p + v * STEP_S + 0.5 * a * STEP_S**2
        v = v + a * STEP_S
        r = r @ cv2.Rodrigues(turn)[0]
        track.append(p)
    last = states[-1]
    assert np.allclose(r, rot_w_b(last.yaw_rad, last.pitch_rad, last.roll_rad), atol=1e-6)
    return np.array(track)


@pytest.mark.parametrize("vehicle", [Plane, Copter])
@pytest.mark.parametrize("flown", [IN_THE_AIR, FROM_THE_GROUND])
def test_a_strapdown_integration_reproduces_the_trajectory(vehicle: type[Plane] | type[Copter], flown: Mission) -> None:
    made = vehicle(flown, PLACE, hills, seed=3)
    states = fly(made, SECONDS)
    assert np.ptp(positions(states)[:, 0]) > 100.0  # the vehicle has moved
    error_m = np.linalg.norm(strapdown(states) - positions(states), axis=1)
    assert error_m.max() < 0.05


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_velocity_is_the_derivative_of_position(vehicle: type[Plane] | type[Copter]) -> None:
    made = vehicle(IN_THE_AIR, PLACE, hills, seed=5)
    states = fly(made, SECONDS)
    velocity = np.array([s.velocity_enu_mps for s in states])
    difference = np.gradient(positions(states), STEP_S, axis=0)
    assert np.abs(difference - velocity)[1:-1].max() < 0.15


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_forces_and_rates_are_those_of_a_small_aircraft(vehicle: type[Plane] | type[Copter]) -> None:
    made = vehicle(FROM_THE_GROUND, PLACE, hills, seed=5)
    states = fly(made, SECONDS)
    force = np.array([s.force_b_mps2 for s in states])
    rates = np.array([s.rates_b_radps for s in states])
    assert np.allclose(force[1:100], [0.0, 0.0, 9.80665 * -1.0], atol=1e-9)  # standing
    assert np.allclose(rates[:100], 0.0)
    assert np.linalg.norm(force, axis=1).max() < 2.5 * 9.81
    assert np.abs(rates).max() < 4.0


@pytest.mark.parametrize("vehicle", [Plane, Copter])
def test_the_flight_is_a_function_of_the_seed(vehicle: type[Plane] | type[Copter]) -> None:
    tracks = []
    for seed in (1, 1, 2):
        made = vehicle(IN_THE_AIR, PLACE, hills, seed=seed)
        tracks.append(positions(fly(made, 20.0)))
    assert np.array_equal(tracks[0], tracks[1])
    assert np.abs(tracks[0] - tracks[2]).max() > 0.1
