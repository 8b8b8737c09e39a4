"""Assembles a closed-loop flight from a scene: vehicle, sensors, autopilot, camera and the pilot's start."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from terrafix import messages as m
from terrafix.core.camera import Mount
from terrafix.core.config import Config
from terrafix.core.errors import UsageError
from terrafix.core.node import Image
from terrafix_lab.sim.autopilot.lockstep import SimAutopilot
from terrafix_lab.sim.autopilot.parameters import BESIDE_A_RECEIVER, GPS_INPUT_ALONE, NO_DCM, Gps, Kind
from terrafix_lab.sim.camera.render import Film, Renderer, Weather
from terrafix_lab.sim.closed_loop.companion import Delays
from terrafix_lab.sim.closed_loop.loop import LoopPlan
from terrafix_lab.sim.flights.folder import (
    AGL_M,
    AGL_SIGMA_M,
    ATTITUDE_SIGMA_DEG,
    CAMERA,
    MAX_DURATION_S,
    START_ERROR_M,
    START_SIGMA_M,
    YAW_SIGMA_DEG,
    mission_over,
)
from terrafix_lab.sim.flights.scene import Scene
from terrafix_lab.sim.interfaces import State, navigation_of
from terrafix_lab.sim.sensors.clock import Clock
from terrafix_lab.sim.sensors.errors import SensorErrors
from terrafix_lab.sim.sensors.gnss_events import AnyEvent
from terrafix_lab.sim.sensors.suite import VehicleSensors
from terrafix_lab.sim.vehicle.copter import Copter
from terrafix_lab.sim.vehicle.plane import Plane
from terrafix_lab.sim.vehicle.wind import BREEZE, Wind
from terrafix_tools.mission.items import Mission, check

FRAME_HZ = 1.5  # ten kilometres are simulated within five minutes
MAX_FRAME_HZ = 10.0
LENGTH_MARGIN = 1.3  # the generated course is longer than the flown distance, since rounded corners cut some off


@dataclass(frozen=True)
class Conditions:
    """Wind, disturbances, sensor errors, camera and delays of a flight."""

    events: Sequence[AnyEvent] = ()
    wind: Wind = BREEZE
    errors: SensorErrors = field(default_factory=SensorErrors)
    film: Film = field(default_factory=Film)
    weather: Weather = field(default_factory=Weather)
    delays: Delays = field(default_factory=Delays)


def plan_over(
    scene: Scene,
    map_path: Path,
    kind: Kind = Kind.PLANE,
    *,
    seed: int,
    mission: Mission | None = None,
    length_m: float = 10_000.0,
    agl_m: float = AGL_M,
    duration_s: float | None = None,
    frame_hz: float = FRAME_HZ,
    gps: Gps = Gps.SECOND,
    conditions: Conditions | None = None,
    config: Config | None = None,
) -> LoopPlan:
    """Builds the plan of a flight to the end of ``mission`` (None: a course of ``length_m``), or for ``duration_s``.

    ``config``: of the companion; ``gps`` sets its GPS number. Raises UsageError, SourceError."""
    check_rates(duration_s, frame_hz)
    applied = conditions or Conditions()
    if mission is not None:
        length_m = math.inf
    else:
        mission = mission_over(scene, kind, seed=seed, length_m=LENGTH_MARGIN * length_m, agl_m=agl_m)
    check(mission, scene.frame, scene.box)
    make_vehicle = Plane if kind is Kind.PLANE else Copter
    vehicle = make_vehicle(mission, scene.frame, scene.height(), wind=applied.wind, seed=seed)
    first = vehicle.state
    ground_m = float(first.p_b_in_w_m[2]) - first.agl_m
    navigation = None if mission.starts_on_ground() else navigation_of(first)
    autopilot = SimAutopilot(
        scene.frame,
        kind,
        start=navigation,
        home_amsl_m=ground_m if navigation is not None else None,
        parameters=parameters_of(kind, gps),
        boot_ns=Clock.of(seed).boot_ns,
    )
    return LoopPlan(
        name=f"closed loop, {mission.name}",
        frame=scene.frame,
        vehicle=vehicle,
        sensors=VehicleSensors(
            scene.frame,
            seed=seed,
            errors=applied.errors,
            events=applied.events,
            airspeed=kind is Kind.PLANE,
        ),
        autopilot=autopilot,
        view=_Camera(scene, applied, seed),
        origin=_origin(scene, first, ground_m, seed),
        map_path=map_path,
        duration_s=duration_s or MAX_DURATION_S,
        length_m=length_m,
        frame_hz=frame_hz,
        delays=applied.delays,
        config=_with_gps(config or Config(), gps),
        over=lambda: vehicle.finished,
    )


def check_rates(duration_s: float | None, frame_hz: float) -> None:
    """Raises UsageError for an invalid duration or frame rate."""
    if duration_s is not None and not 0.0 < duration_s <= MAX_DURATION_S:
        raise UsageError(f"--duration {duration_s:g}: choose more than 0 and at most {MAX_DURATION_S:g} seconds")
    if not 0.0 < frame_hz <= MAX_FRAME_HZ:
        raise UsageError(f"--frame-hz {frame_hz:g}: choose more than 0 and at most {MAX_FRAME_HZ:g}")


def parameters_of(kind: Kind, gps: Gps) -> dict[str, float]:
    """Returns the parameters that config/vehicles sets."""
    chosen = BESIDE_A_RECEIVER if gps is Gps.SECOND else GPS_INPUT_ALONE
    return chosen | (NO_DCM if kind is Kind.PLANE else {})


class _Camera:
    """Renders the image at the vehicle's true pose."""

    def __init__(self, scene: Scene, applied: Conditions, seed: int) -> None:
        self._renderer = Renderer(scene.ground, CAMERA, film=applied.film, weather=applied.weather, seed=seed)
        self._r_b_c = Mount.of(CAMERA).r_b_c()

    def __call__(self, state: State, index: int) -> Image:
        return self._renderer.frame(state.p_b_in_w_m, state.r_w_b() @ self._r_b_c, index, t_s=state.t_s)


def _origin(scene: Scene, first: State, ground_m: float, seed: int) -> m.Origin:
    """Returns the start as a pilot gives it: the truth plus START_ERROR_M."""
    start_m = first.p_b_in_w_m[:2] + np.random.default_rng([seed, 42]).normal(0.0, START_ERROR_M, 2)
    lat_deg, lon_deg = scene.frame.to_wgs84(float(start_m[0]), float(start_m[1]))
    return m.Origin(
        t_ns=0,
        camera=CAMERA,
        lat_deg=lat_deg,
        lon_deg=lon_deg,
        ground_amsl_m=ground_m,
        start_sigma_m=START_SIGMA_M,
        yaw_sigma_deg=YAW_SIGMA_DEG,
        agl_sigma_m=AGL_SIGMA_M,
        attitude_sigma_deg=ATTITUDE_SIGMA_DEG,
    )


def _with_gps(config: Config, gps: Gps) -> Config:
    """Returns the configuration with the GPS number of Terrafix."""
    link = msgspec.structs.replace(config.link, gps_id=1 if gps is Gps.SECOND else 0)
    return msgspec.structs.replace(config, link=link)
