"""A simulated plane with the sensors of an autopilot, and the odometry and map matches of its
frames."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import msgspec
import numpy as np

from map_matches import plane
from simulated_flight import CAMERA, KEYFRAME_EVERY, PLACE, EstimatorRun, keyframe_of
from simulated_flight import ORIGIN as STEADY_ORIGIN
from simulated_flight import blind as without_features
from terrafix.core.camera import Mount
from terrafix.core.pose import exp_so3
from terrafix.messages import (
    Health,
    Imu,
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    ThermalBand,
    VehicleState,
)
from terrafix_lab.sim.flights.path import STEP_S
from terrafix_lab.sim.interfaces import State
from terrafix_lab.sim.sensors.suite import VehicleSensors
from terrafix_lab.sim.true_messages import first_odometry, map_match, odometry, vehicle_state
from terrafix_lab.sim.true_messages import flown as sent_by
from terrafix_lab.sim.vehicle.plane import Plane
from terrafix_lab.sim.vehicle.wind import Wind
from terrafix_tools.mission.course import course
from terrafix_tools.mission.items import Box

FRAME_EVERY, STATE_EVERY, BATCH = 50, 2, 3
FIX_EVERY = 4
ORIGIN = msgspec.structs.replace(STEADY_ORIGIN, yaw_sigma_deg=3.0, agl_sigma_m=3.0, attitude_sigma_deg=0.7)


class InertialFlight:
    """One frame in ``frame_every`` steps: one per second. ``messages_by_frame[i]``: telemetry since the previous frame,
    then odometry and map match.

    Truth per frame: ``poses`` of its picture (R_w_c, position of the camera in ENU relative to the start coordinate);
    at its time stamp ``true_m`` (that position) and ``velocity_mps`` (ENU)."""

    def __init__(
        self,
        seed: int,
        seconds: int = 70,
        frame_every: int = FRAME_EVERY,
        delay: Callable[[float], float] = lambda _t_s: 0.0,
    ) -> None:
        """``delay``: seconds by which the picture of a frame is older than its time stamp, by that time."""
        rng = np.random.default_rng([seed, 78])
        mission = course(seed, 40.0 * seconds, Box(-1500.0, -1500.0, 1500.0, 1500.0), PLACE, agl_m=120.0)
        plane = Plane(mission, PLACE, lambda e, n: 0.0, wind=Wind(5.4, 1.0), seed=seed)
        tilt = np.radians(rng.normal(0.0, CAMERA.mount_tolerance_deg / 2, 2))
        mount = Mount.of(CAMERA).r_b_c() @ exp_so3(np.array([*tilt, 0.0]))
        start = plane.state.p_b_in_w_m[:2] + rng.normal(0.0, ORIGIN.start_sigma_m, 2)
        self.poses: list[tuple[np.ndarray, np.ndarray]] = []
        self.true_m: list[np.ndarray] = []
        self.velocity_mps: list[np.ndarray] = []
        states: list[State] = []
        self.messages_by_frame: list[list[Message]] = []
        telemetry: list[Message] = []
        steps = sent_by(
            plane,
            VehicleSensors(PLACE, seed=seed),
            round(seconds / STEP_S),
            vehicle_state,
            state_every=STATE_EVERY,
            imu_batch=BATCH,
        )
        for i, (state, sent) in enumerate(steps):
            telemetry += sent
            states.append(state)
            if i % frame_every == 0:
                shown, t_ns = states[max(0, i - round(delay(state.t_s) / STEP_S))], round(state.t_s * 1e9)
                self.poses.append((shown.r_w_b() @ mount, shown.p_b_in_w_m - np.array([*start, 0.0])))
                self.true_m.append(state.p_b_in_w_m - np.array([*start, 0.0]))
                self.velocity_mps.append(state.velocity_enu_mps)
                frame_id = len(self.messages_by_frame)
                messages = [*telemetry, self._odometry(frame_id, t_ns, rng)]
                if frame_id and frame_id % FIX_EVERY == 0:
                    messages.append(self.fix(frame_id, t_ns, rng))
                self.messages_by_frame.append(messages)
                telemetry = []

    def _odometry(self, i: int, t_ns: int, rng: np.random.Generator) -> Odometry:
        if i == 0:
            return first_odometry(t_ns)
        return self.registered(i, keyframe_of(i), t_ns, rng, becomes_keyframe=i % KEYFRAME_EVERY == 0)

    def registered(
        self, i: int, keyframe: int, t_ns: int, rng: np.random.Generator, *, becomes_keyframe: bool
    ) -> Odometry:
        """Odometry of frame ``i`` against the frame ``keyframe``."""
        poses = self.poses[keyframe], self.poses[i]
        return odometry(t_ns, (keyframe, i), poses, rng, becomes_keyframe=becomes_keyframe)

    def fix(self, i: int, t_ns: int, rng: np.random.Generator) -> MapMatch:
        return map_match(t_ns, i, self.poses[i], rng, ground=plane(0.0))


@dataclass(frozen=True)
class InertialErrors:
    """One row per frame: the last published estimate. Errors are estimate minus truth, ENU."""

    estimates: list[NavEstimate]
    position_error_m: np.ndarray  # (N, 2)
    position_sigma_m: np.ndarray  # (N, 2)
    velocity_error_mps: np.ndarray  # (N, 3)
    velocity_sigma_mps: np.ndarray  # (N,)
    verdicts: list[MeasurementVerdict]  # all of the flight


def flown(
    flight: InertialFlight,
    *,
    imu: bool,
    band: ThermalBand = ThermalBand.NORMAL,
    blind: tuple[int, int] = (0, 0),
    no_imu: tuple[float, float] = (0.0, 0.0),
    airspeed: bool = False,
    iced: float = 1.0,
    no_camera: tuple[int, int] = (0, 0),
    frames: int = 1000,
) -> InertialErrors:
    """Runs an EstimatorNode on the first ``frames`` frames of a flight.

    ``imu``, ``airspeed``: the telemetry has them. ``blind``: frames (first, end) without tracked features and map
    match. ``no_imu``: interval (begin, end) [s] without inertial readings. ``iced``: scale factor of the airspeed
    sensor in the blind frames. ``no_camera``: frames (first, end) that are missing."""
    run = EstimatorRun()
    cause = Health(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")
    assert run.feed([ORIGIN, cause]) == []
    for i, messages in enumerate(flight.messages_by_frame[:frames]):
        for message in _with_outages(messages, imu, range(*blind), i, no_imu):
            if isinstance(message, VehicleState):
                read_mps = (message.airspeed_mps or 0.0) * (iced if i in range(*blind) else 1.0)
                message = msgspec.structs.replace(message, airspeed_mps=read_mps if airspeed else None)
            if i in range(*no_camera) and isinstance(message, (Odometry, MapMatch)):
                continue
            run.feed([message])
    rows = run.estimates()
    errors_m = [np.array([*PLACE.to_local(e.lat_deg, e.lon_deg)]) - flight.poses[e.frame_id][1][:2] for e in rows]
    return InertialErrors(
        rows,
        np.array(errors_m),
        np.sqrt(np.array([[e.cov[0], e.cov[7]] for e in rows])),
        np.array([e.velocity_enu_mps for e in rows]) - np.array([flight.velocity_mps[e.frame_id] for e in rows]),
        np.array([e.velocity_sigma_mps for e in rows]),
        [m for m in run.published if isinstance(m, MeasurementVerdict)],
    )


def _with_outages(
    messages: list[Message], imu: bool, blind: range, i: int, no_imu: tuple[float, float]
) -> Iterable[Message]:
    """The messages of frame i as they arrive with these outages (see ``flown``)."""
    for message in messages:
        if isinstance(message, Imu) and (not imu or no_imu[0] <= message.t_ns * 1e-9 < no_imu[1]):
            continue
        if i in blind and isinstance(message, MapMatch):
            continue
        yield without_features(message) if i in blind and isinstance(message, Odometry) else message
