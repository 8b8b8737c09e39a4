"""The true trajectory of a flight, and the telemetry of its autopilot.

World: east, north, up AMSL [m] around the start coordinate of the pilot, which is the estimator's local frame. The
earth is flat here as in the estimator; geodesy is not tested."""

import math
from dataclasses import dataclass, replace

import msgspec
import numpy as np

from terrafix.core.camera import Mount
from terrafix.core.geodesy import LocalFrame
from terrafix.core.pose import exp_so3, log_so3
from terrafix.messages import GimbalAttitude, Message, Origin, VehicleState
from terrafix_lab.faults.edits import Span
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.ground import Terrain
from terrafix_lab.montecarlo.plan import FlightPlan
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.mount import Fixed, Gimbal
from terrafix_lab.sim.flights.path import STEP_S
from terrafix_lab.sim.interfaces import Readings, State
from terrafix_lab.sim.sensors.errors import SensorErrors
from terrafix_lab.sim.sensors.suite import VehicleSensors
from terrafix_lab.sim.true_messages import flown, vehicle_state
from terrafix_lab.sim.vehicle.copter import Copter, CopterLimits
from terrafix_lab.sim.vehicle.plane import Plane, PlaneLimits
from terrafix_tools.mission.course import course
from terrafix_tools.mission.items import Box, Mission

LAT_DEG, LON_DEG = 48.0, 11.0  # any place: only the estimator's conversions to and from the local frame use it
HALF_BOX_M = 1500.0
SPARE = 1.2  # length of the course over what is flown of it
CLIMBS = 0.25  # 1-sigma of a waypoint's height, as a share of the flight's
MIN_AGL_M = 60.0
TELEMETRY_EVERY, SLOW_EVERY = 2, 5  # steps: attitude at 25 Hz with inertial readings, 10 Hz without
IMU_BATCH = 5  # readings in a message, at 50 Hz
GIMBAL_EVERY = 10  # steps: reports at 5 Hz [spec: STREAMS_HZ]
YAW_SIGMA_DEG, AGL_SIGMA_M, ATTITUDE_SIGMA_DEG = 3.0, 3.0, 0.7  # as `terrafix sim make` states them


@dataclass(frozen=True)
class Shot:
    """True pose and velocity of one frame."""

    t_s: float
    p_m: np.ndarray  # (3,) of the camera, which is at the origin of the body
    r_w_c: np.ndarray  # (3, 3)
    r_w_b: np.ndarray  # (3, 3) of the body, or of the stabilised frame of a gimbal that reports nothing
    velocity_mps: np.ndarray  # (3,)
    scale: tuple[float, float] = (1.0, 1.0)  # of the picture's content about its centre; negative: mirrored
    dark: bool = False  # the picture shows nothing

    def scaled(self, x: float, y: float) -> "Shot":
        """The Sight of terrafix_lab/faults/pictures.py. Both axes mirrored are a camera turned about its axis."""
        turn = np.diag([-1.0, -1.0, 1.0]) if x < 0.0 and y < 0.0 else np.eye(3)
        sign = -1.0 if x < 0.0 and y < 0.0 else 1.0
        return replace(self, r_w_c=self.r_w_c @ turn, scale=(sign * x * self.scale[0], sign * y * self.scale[1]))

    def darkened(self) -> "Shot":
        return replace(self, dark=True)


@dataclass(frozen=True)
class SimulatedFlight:
    origin: Origin
    frames: list[Shot]
    pictures: list[Shot]  # content of each frame: the truth at its exposure, with the stated time
    telemetry: list[list[Message]]  # before each frame
    path_m: np.ndarray  # (N,) flown over ground up to each frame
    terrain: Terrain  # in the estimator's local frame
    lie: Span | None = None  # of a false input of the table of faults

    def at(self, t_s: float) -> Shot:
        """The truth at any time of the flight. Between frames: cubic Hermite position, constant angular rate."""
        times_s = [shot.t_s for shot in self.frames]
        i = int(np.clip(np.searchsorted(times_s, t_s, side="right") - 1, 0, len(times_s) - 2))
        a, b = self.frames[i], self.frames[i + 1]
        dt_s = b.t_s - a.t_s
        u = (t_s - a.t_s) / dt_s
        p_m = (
            (2 * u**3 - 3 * u**2 + 1) * a.p_m
            + (u**3 - 2 * u**2 + u) * dt_s * a.velocity_mps
            + (3 * u**2 - 2 * u**3) * b.p_m
            + (u**3 - u**2) * dt_s * b.velocity_mps
        )
        turned = [ra @ exp_so3(u * log_so3(ra.T @ rb)) for ra, rb in ((a.r_w_c, b.r_w_c), (a.r_w_b, b.r_w_b))]
        return Shot(t_s, p_m, turned[0], turned[1], (1 - u) * a.velocity_mps + u * b.velocity_mps)


def fly(plan: FlightPlan, terrain: Terrain) -> SimulatedFlight:
    """Flies ``plan``. ``terrain``: in the frame of the mission."""
    frame = LocalFrame(LAT_DEG, LON_DEG)
    vehicle = _vehicle(plan, terrain, frame)
    errors = SensorErrors(yaw_constant_rad=plan.compass_rad)
    hanging = Gimbal(seed=plan.seed) if plan.gimbal else Fixed()
    sensors = VehicleSensors(frame, seed=plan.seed, errors=errors, airspeed=plan.kind is Kind.PLANE)
    r_b_c = Mount.of(plan.camera).r_b_c()
    tilt = exp_so3(np.array([*plan.mount_error_rad, 0.0]))
    claimed = vehicle.state.p_b_in_w_m[:2] + np.array(plan.start_error_m)
    home_m = terrain.bare_at_m(float(claimed[0]), float(claimed[1]))
    frame_every = round(1.0 / (plan.frame_hz * STEP_S))
    lag = round(plan.picture_lag_s / STEP_S)
    frames: list[Shot] = []
    pictures: list[Shot] = []
    taken: Shot | None = None  # the picture that is delivered next, when pictures are late
    telemetry: list[list[Message]] = []
    waiting: list[Message] = []
    path_m, paths_m = 0.0, []

    def shot(at: State) -> Shot:
        held = hanging.r_w_c(at)
        p_m = at.p_b_in_w_m - np.array([*claimed, 0.0])
        r_w_b = at.r_w_b() if plan.gimbal_reports else held @ r_b_c.T
        return Shot(at.t_s, p_m, held @ tilt, r_w_b, at.velocity_enu_mps)

    steps = flown(
        vehicle,
        sensors,
        math.floor(plan.duration_s / STEP_S),
        lambda readings: _vehicle_state(plan, readings, home_m),
        state_every=TELEMETRY_EVERY if plan.has_imu else SLOW_EVERY,
        imu_batch=IMU_BATCH if plan.has_imu else 0,
    )
    for i, (state, sent) in enumerate(steps):
        path_m += float(np.hypot(*state.velocity_enu_mps[:2])) * STEP_S if i else 0.0
        waiting += sent
        if plan.gimbal_reports and i % GIMBAL_EVERY == 0:
            waiting.append(_gimbal_attitude(hanging, state))
        if i % frame_every == 0:
            frames.append(shot(state))
            pictures.append(replace(taken or frames[-1], t_s=state.t_s))
            telemetry.append(waiting[-1:] if plan.fault is DrawnFault.PHOTOS else waiting)
            waiting = []
            paths_m.append(path_m)
        if lag and (i + lag) % frame_every == 0:
            taken = shot(state)
    return SimulatedFlight(
        _origin(plan, home_m), frames, pictures, telemetry, np.array(paths_m), terrain.seen_from(claimed)
    )


def _vehicle(plan: FlightPlan, terrain: Terrain, frame: LocalFrame) -> Plane | Copter:
    mission, height = _mission(plan, frame), terrain.bare_at_m
    if plan.kind is Kind.PLANE:
        quick = PlaneLimits(cruise_mps=plan.cruise_mps)
        return Plane(mission, frame, height, wind=plan.wind, seed=plan.seed, limits=quick)
    slow = CopterLimits(cruise_mps=plan.cruise_mps)
    return Copter(mission, frame, height, wind=plan.wind, seed=plan.seed, limits=slow)


def _mission(plan: FlightPlan, frame: LocalFrame) -> Mission:
    """A closed course with another height at every waypoint."""
    box = Box(-HALF_BOX_M, -HALF_BOX_M, HALF_BOX_M, HALF_BOX_M)
    length_m = SPARE * (plan.cruise_mps + plan.wind.speed_mps()) * plan.duration_s
    drawn = course(plan.seed, length_m, box, frame, agl_m=plan.agl_m)
    heights = np.random.default_rng([plan.seed, 54]).normal(1.0, CLIMBS, len(drawn.items))
    items = [
        replace(item, height_m=max(MIN_AGL_M, plan.agl_m * float(share)))
        for item, share in zip(drawn.items, heights, strict=True)
    ]
    return replace(drawn, items=tuple(items))


def _vehicle_state(plan: FlightPlan, readings: Readings, home_m: float) -> VehicleState:
    """As the link publishes it. Roll and pitch of a camera on a gimbal that reports nothing are unknown."""
    state = vehicle_state(readings, home_m)
    assert state.agl_m is not None
    state = msgspec.structs.replace(state, agl_m=plan.height_scale * state.agl_m)
    return (
        msgspec.structs.replace(state, pitch_rad=None, roll_rad=None)
        if plan.gimbal and not plan.gimbal_reports
        else state
    )


def _gimbal_attitude(hanging: Fixed | Gimbal, state: State) -> GimbalAttitude:
    q = hanging.reported(state)
    assert q is not None
    return GimbalAttitude(t_ns=round(state.t_s * 1e9), q=q, from_north=True)


def _origin(plan: FlightPlan, home_m: float) -> Origin:
    return Origin(
        t_ns=0,
        camera=plan.camera,
        lat_deg=LAT_DEG,
        lon_deg=LON_DEG,
        ground_amsl_m=home_m,
        start_sigma_m=plan.start_sigma_m,
        yaw_sigma_deg=YAW_SIGMA_DEG,
        agl_sigma_m=AGL_SIGMA_M,
        attitude_sigma_deg=ATTITUDE_SIGMA_DEG,
    )
