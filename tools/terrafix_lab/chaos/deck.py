"""A copter that stands disarmed on a deck that moves, takes off from it, and flies the two legs of the fault matrix."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from terrafix_lab.chaos.scene import COURSE, WAY, ChaosScene, course_of, mission_along
from terrafix_lab.faults.fault import Phase
from terrafix_lab.faults.table import DECK_S
from terrafix_lab.sim.autopilot.course import read_course
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import FRAME_HZ, Flight, flight_over, write_flight
from terrafix_lab.sim.flights.make import MAP_NAME, FlightOptions, scene_of, write_map
from terrafix_lab.sim.flights.path import STEP_S, FlownPath

DECK_MPS = 6.0  # of the deck, east
CARRIED_S, SLOWING_S = 10.0, 10.0  # after the take-off with the speed of the deck; until that is gone
LIFT_M = 0.05  # above the ground it has taken off
CLEAR_M = 1.5  # of the deck above the ground below it


def deck_in(folder: Path, seed: int) -> ChaosScene:
    """The scene in ``folder``, which is generated if it is not there. Raises OutputError, SourceError."""
    if not (folder / COURSE).exists():
        wanted = FlightOptions(seed=seed, vehicle=Kind.COPTER)
        scene, place = scene_of(wanted)
        ashore = flight_over(scene, Kind.COPTER, seed=seed, mission=mission_along("from a deck", seed, WAY))
        flight = from_deck(ashore)
        write_flight(folder, _seen(flight), MAP_NAME, seed=seed, telemetry=False)
        write_map(folder / MAP_NAME, wanted, place)
        course_of(flight, folder)  # last: what was cut off is generated anew
    course, jpegs = read_course(folder / COURSE), sorted((folder / "frames").glob("*.jpg"))
    return ChaosScene(folder / MAP_NAME, jpegs, course, {Phase.START: 0.0}, len(jpegs) / FRAME_HZ, disarmed=True)


def from_deck(flight: Flight) -> Flight:
    """``flight`` from ground to ground, with DECK_S before its take-off on a deck that moves east, and the motion
    of the deck at first."""
    first, count = flight.path.states[0], round(DECK_S / STEP_S)
    lifted = next(k for k, state in enumerate(flight.path.states) if state.p_b_in_w_m[2] - first.p_b_in_w_m[2] > LIFT_M)
    states = [first] * count + flight.path.states[lifted:]
    t_s = STEP_S * np.arange(len(states))
    carried = np.clip(1.0 - (t_s - DECK_S - CARRIED_S) / SLOWING_S, 0.0, 1.0)
    # It comes to where the flight was without a deck; the deck is above the ground along its way.
    east_m = STEP_S * DECK_MPS * (np.cumsum(carried) - np.sum(carried))
    places_m = np.array([s.p_b_in_w_m for s in states])
    way_m = first.p_b_in_w_m[0] + east_m[: count + 1], np.full(count + 1, first.p_b_in_w_m[1])
    deck_m = CLEAR_M + float(flight.ground.height_amsl_m(*(axis[None] for axis in way_m)).max())
    offset_m = np.column_stack([east_m, np.zeros(len(states)), carried * (deck_m - first.p_b_in_w_m[2])])
    places_m, velocity_mps = places_m + offset_m, np.gradient(offset_m, STEP_S, axis=0)
    ground_m = flight.ground.height_amsl_m(places_m[None, :, 0], places_m[None, :, 1])[0]
    moved = [
        replace(
            state,
            t_s=float(t_s[k]),
            p_b_in_w_m=places_m[k],
            velocity_enu_mps=state.velocity_enu_mps + velocity_mps[k],
            agl_m=0.0 if k < count else float(places_m[k, 2] - ground_m[k]),
        )
        for k, state in enumerate(states)
    ]
    return replace(flight, path=FlownPath(moved), duration_s=flight.duration_s + (count - lifted) * STEP_S)


def _seen(flight: Flight) -> Flight:
    """On the deck the camera sees the deck: one view."""
    count, states = round(DECK_S / STEP_S), flight.path.states
    return replace(flight, path=FlownPath([states[0]] * count + states[count:]))
