"""A copter that flies the two legs of the fault matrix forth and back without end, for flights that last."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.chaos.scene import COURSE, LEG_M, ChaosScene, course_of, mission_along
from terrafix_lab.sim.autopilot.course import read_course
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.flights.folder import FRAME_HZ, Flight, flight_over, write_flight
from terrafix_lab.sim.flights.make import MAP_NAME, FlightOptions, scene_of, write_map
from terrafix_lab.sim.flights.path import STEP_S, FlownPath
from terrafix_lab.sim.interfaces import State

RUN = "run"  # folder of the run, beside that of the generated flight
A, B, C = (0.0, 0.0), (LEG_M, 0.0), (LEG_M, LEG_M)  # east and north of the take-off
WAY = (B, C, B, A, B)  # a lap from the middle of the first leg to that of the last, and what comes before and after
PERIOD_STEPS = round(1.0 / FRAME_HZ / STEP_S)  # whole periods of a camera at a multiple of FRAME_HZ, too
MAX_CAMERA_HZ = 60.0  # [spec: files of a folder have four digits, a lap takes two minutes]
AFTER_STEPS = round(0.2 / STEP_S)  # of the next lap: the course has a row at the end of the lap, and one after it

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]  # east, north [m] (1, N) -> ground, metres AMSL (1, N)


def shuttle_in(out: Path, seed: int, camera_hz: float = FRAME_HZ) -> ChaosScene:
    """The endless scene of the flight in ``out``, which is generated if it is not there. Raises OutputError (``out``
    has a run already), SourceError, UsageError."""
    if not 0.0 < camera_hz <= MAX_CAMERA_HZ or camera_hz % FRAME_HZ:
        raise UsageError(f"--camera-hz {camera_hz:g}: choose a multiple of {FRAME_HZ:g} up to {MAX_CAMERA_HZ:g}")
    if (out / RUN).exists():
        raise OutputError(f"{out / RUN}: exists; give a new folder")
    folder = out / f"shuttle-{seed}-{camera_hz:g}hz"
    if not (folder / COURSE).exists():
        _generate(folder, seed, camera_hz)
    return endless(folder, camera_hz)


@dataclass(frozen=True)
class EndlessScene(ChaosScene):
    """A scene that begins anew after its last image. No image comes twice within a lap: a vehicle in the air never has
    the very same view again, and images that repeat one of the last 40 are a stale buffer (vision)."""

    def jpeg(self, t_s: float) -> bytes:
        return self.jpegs[round(t_s * self.frame_hz) % len(self.jpegs)].read_bytes()


def endless(folder: Path, camera_hz: float = FRAME_HZ) -> ChaosScene:
    """The lap in ``folder`` (images, map, course) again and again. Raises SourceError."""
    course, jpegs = read_course(folder / COURSE), sorted((folder / "frames").glob("*.jpg"))
    lap_s = len(jpegs) / camera_hz
    return EndlessScene(folder / MAP_NAME, jpegs, lambda t_s: course(t_s % lap_s), {}, math.inf, frame_hz=camera_hz)


def _generate(folder: Path, seed: int, camera_hz: float) -> None:
    wanted = FlightOptions(seed=seed, vehicle=Kind.COPTER)
    scene, place = scene_of(wanted)
    flown = flight_over(scene, Kind.COPTER, seed=seed, mission=mission_along("shuttle", seed, WAY))
    flight = replace(lap_of(flown), frame_hz=camera_hz)
    write_flight(folder, flight, MAP_NAME, seed=seed, telemetry=False)
    write_map(folder / MAP_NAME, wanted, place)
    course_of(flight, folder)  # last: what was cut off is generated anew


def lap_of(flown: Flight) -> Flight:
    """The part of a flight along WAY from the middle of the first leg to that of the last, closed."""
    begin, count = lap_steps(flown.path.states)
    states = closed(flown.path.states[begin : begin + count + 1], flown.ground.height_amsl_m)
    east_m, north_m = states[0].p_b_in_w_m[:2].tolist()
    return replace(
        flown,
        path=FlownPath([*states, *states[:AFTER_STEPS]]),
        duration_s=len(states) * STEP_S,
        start_wgs84=flown.frame.to_wgs84(east_m, north_m),
    )


def lap_steps(states: list[State]) -> tuple[int, int]:
    """-> index of the first state of the lap, and number of steps, whole periods of the camera: the vehicle comes by
    the middle of the first leg for the first time, and is there again with the same velocity."""
    place_m = np.array([state.p_b_in_w_m for state in states])
    velocity_mps = np.array([state.velocity_enu_mps for state in states])
    begin = int(np.argmax(np.hypot(*(place_m - place_m[0])[:, :2].T) > LEG_M / 2))
    leg_steps = round(LEG_M / float(np.linalg.norm(velocity_mps[begin])) / STEP_S)  # at least, to be elsewhere
    ends = np.arange(begin, len(states), PERIOD_STEPS)
    ends = ends[ends > begin + leg_steps]
    apart = np.hypot(
        np.linalg.norm(place_m[ends] - place_m[begin], axis=1),
        np.linalg.norm(velocity_mps[ends] - velocity_mps[begin], axis=1),
    )
    return begin, int(ends[np.argmin(apart)]) - begin


def closed(states: list[State], ground_amsl_m: Heights) -> list[State]:
    """All ``states`` but the last, moved and turned evenly over the lap, so that the last would be the first. Rates and
    specific forces stay as they were: those of the vehicle are computed from its course."""
    first, last, count = states[0], states[-1], len(states) - 1
    lap_s = count * STEP_S
    gap_m = last.p_b_in_w_m - first.p_b_in_w_m
    yaw, pitch, roll = (math.remainder(b - a, math.tau) for a, b in zip(_angles(first), _angles(last), strict=True))
    places_m = np.array([s.p_b_in_w_m - k / count * gap_m for k, s in enumerate(states[:-1])])
    ground_m = ground_amsl_m(places_m[None, :, 0], places_m[None, :, 1])[0]
    return [
        replace(
            state,
            t_s=k * STEP_S,
            p_b_in_w_m=places_m[k],
            velocity_enu_mps=state.velocity_enu_mps - gap_m / lap_s,
            yaw_rad=math.remainder(state.yaw_rad - k / count * yaw, math.tau),
            pitch_rad=state.pitch_rad - k / count * pitch,
            roll_rad=state.roll_rad - k / count * roll,
            agl_m=float(places_m[k, 2] - ground_m[k]),
        )
        for k, state in enumerate(states[:-1])
    ]


def _angles(state: State) -> tuple[float, float, float]:
    return state.yaw_rad, state.pitch_rad, state.roll_rad
