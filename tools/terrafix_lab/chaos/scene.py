"""The flight of the fault matrix: a copter over a generated place, from take-off to landing, with its phases."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import Camera
from terrafix_lab.faults.fault import Phase
from terrafix_lab.sim.autopilot.course import Course, PeerState, peer_state_of, read_course, write_course
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import AGL_M as FLIGHT_AGL_M
from terrafix_lab.sim.flights.folder import CAMERA, FRAME_HZ, Flight
from terrafix_lab.sim.flights.make import MAP_NAME, FlightOptions, make
from terrafix_lab.sim.world import place as world
from terrafix_tools.mission.file import write_mission
from terrafix_tools.mission.items import Do, Item, Mission

AGL_M = 100.0
LEG_M = 250.0  # of the two legs, east and then north
WAY = ((LEG_M, 0.0), (LEG_M, LEG_M))
AIR_S = 150.0  # of a flight in the air
AGL_OF = {Kind.COPTER: AGL_M, Kind.PLANE: FLIGHT_AGL_M}
STEP_S = 0.1  # of the course
CRUISE_SHARE = 0.95  # of the greatest height
STRAIGHT_RADPS = 0.05  # a turn is faster
AFTER_S = 30.0  # of a flight without a landing that must be left after a fault
LEAD_S = 12.0  # flown before the fault, for the first fixes
COURSE = "course.csv"


@dataclass(frozen=True)
class ChaosScene:
    """``at_s``: seconds of the flight at which the fault of each phase begins. ``truth_sigma_m``: of the course.
    ``attitude_sigma_deg``: of roll and pitch that are reported; None: the default."""

    map_path: Path
    jpegs: list[Path]
    course: Course
    at_s: dict[Phase, float]
    duration_s: float
    camera: Camera = CAMERA
    frame_hz: float = FRAME_HZ
    truth_sigma_m: float = 0.0
    attitude_sigma_deg: float | None = None
    kind: Kind = Kind.COPTER
    disarmed: bool = False  # at its beginning
    elsewhere: Callable[[float], bytes] | None = None  # as ``jpeg``, of another place

    def begin_s(self, phase: Phase, lasts_s: float) -> float:
        """Second of the flight at which a fault begins, so early that a flight without a landing goes on after it."""
        if Phase.LANDING in self.at_s or self.disarmed:
            return self.at_s[phase]
        return max(LEAD_S, min(self.at_s[phase], self.duration_s - lasts_s - AFTER_S))

    def jpeg(self, t_s: float) -> bytes:
        """The image whose exposure is nearest to a time of the flight."""
        index = min(max(0, round(t_s * self.frame_hz)), len(self.jpegs) - 1)
        return self.jpegs[index].read_bytes()


def scene_in(folder: Path, seed: int, in_air: Kind | None = None, *, camera: Camera = CAMERA) -> ChaosScene:
    """The flight in ``folder``, which is generated if it is not there: of a copter from ground to ground, or of
    ``in_air`` in the air. Raises OutputError, SourceError."""
    kind = in_air or Kind.COPTER
    if not (folder / COURSE).exists():
        wanted = FlightOptions(seed=seed, vehicle=kind, duration_s=AIR_S, agl_m=AGL_OF[kind], camera=camera)
        if in_air is None:
            mission = folder.with_suffix(".waypoints")
            write_mission(mission, mission_along("two legs", seed, WAY))
            wanted = FlightOptions(seed=seed, mission=mission, vehicle=kind, camera=camera)
        course_of(make(folder, wanted, progress=False), folder)
    course = read_course(folder / COURSE)
    jpegs = sorted((folder / "frames").glob("*.jpg"))
    if not jpegs:
        raise SourceError(f"{folder}: has no images; remove it, and it is generated anew")
    duration_s = len(jpegs) / FRAME_HZ
    at_s = phases(course, duration_s) if in_air is None else phases_in_the_air(course, duration_s)
    return ChaosScene(folder / MAP_NAME, jpegs, course, at_s, duration_s, camera, kind=kind)


def course_of(flight: Flight, folder: Path) -> Course:
    """The true course of a flight, which is written into its folder. Raises OutputError, SourceError."""
    write_course(folder / COURSE, _states(flight))
    return read_course(folder / COURSE)


def mission_along(name: str, seed: int, way_m: Sequence[tuple[float, float]]) -> Mission:
    """Take-off in the middle of the place of ``seed``, legs at AGL_M above it along ``way_m`` (east and north of it),
    landing at their end."""
    place = world.generate(seed)
    x, y = place.layout.width_m / 2, place.layout.height_m / 2
    corners = [place.wgs84(x + east_m, y - north_m) for east_m, north_m in way_m]
    items = (
        Item(Do.TAKE_OFF, height_m=AGL_M),
        *(Item(Do.WAYPOINT, i + 1, *corner, height_m=AGL_M) for i, corner in enumerate(corners)),
        Item(Do.LAND, len(corners) + 1, *corners[-1], height_m=0.0),
    )
    return Mission(name, *place.wgs84(x, y), items)


def _states(flight: Flight) -> list[tuple[float, PeerState]]:
    rows = []
    for t_s in np.arange(0.0, flight.path.duration_s, STEP_S).tolist():
        state = peer_state_of(flight.path.state(t_s), flight.frame)
        rows.append((t_s, replace(state, airspeed_mps=math.nan)))  # it has no sensor of airspeed
    return rows


def phases(course: Course, duration_s: float) -> dict[Phase, float]:
    """Times of the faults of a flight from ground to ground."""
    times = np.arange(0.0, duration_s, STEP_S)
    states = [course(t_s) for t_s in times.tolist()]
    agl_m = np.array([state.agl_m for state in states])
    turn_radps = np.abs(np.gradient(np.unwrap([state.yaw_rad for state in states]), STEP_S))
    high = agl_m > CRUISE_SHARE * agl_m.max()
    landing_s = float(times[np.flatnonzero(high)[-1]])
    usable = high & (times >= times[np.flatnonzero(high)[0]] + LEAD_S) & (times < landing_s - LEAD_S)
    cruise_s = middle_of_longest(times, usable & (turn_radps < STRAIGHT_RADPS))
    turn_s = float(times[np.argmax(np.where(usable, turn_radps, -1.0))])
    return {
        Phase.START: cruise_s,
        Phase.CRUISE: cruise_s,
        Phase.TURN: turn_s,
        Phase.DARK: cruise_s,
        Phase.LANDING: landing_s,
    }


def phases_in_the_air(course: Course, duration_s: float) -> dict[Phase, float]:
    """Times of the faults of a flight that begins and ends in the air, so without a landing. Raises SourceError."""
    times = np.arange(0.0, duration_s, STEP_S)
    yaw_rad = np.unwrap([course(t_s).yaw_rad for t_s in times.tolist()])
    turn_radps = np.abs(np.gradient(yaw_rad, STEP_S))
    usable = (times > LEAD_S) & (times < duration_s - AFTER_S)
    straight = usable & (turn_radps < STRAIGHT_RADPS)
    if not straight.any():
        raise SourceError(f"the flight has no straight part between {LEAD_S:g} s and {AFTER_S:g} s before its end")
    cruise_s = middle_of_longest(times, straight)
    turn_s = float(times[np.argmax(np.where(usable, turn_radps, -1.0))])
    return {Phase.START: cruise_s, Phase.CRUISE: cruise_s, Phase.TURN: turn_s, Phase.DARK: cruise_s}


def middle_of_longest(times: np.ndarray, chosen: np.ndarray) -> float:
    """The time in the middle of the longest run of ``chosen`` (bool, as long as ``times``)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], chosen.astype(np.int8), [0]))))
    runs = edges.reshape(-1, 2)
    first, last = runs[np.argmax(runs[:, 1] - runs[:, 0])]
    return float(times[(first + last - 1) // 2])
