"""How a graph begins: from the start of the flight, from a checkpoint, and anew in flight. There is one `reset`."""

import math
from dataclasses import dataclass
from enum import StrEnum

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.pose import tangent_to_world, world_to_tangent
from terrafix.estimator.filter_state import FilterState, FrameContinuity, FrameInput, FrameState, scale_sigma
from terrafix.estimator.graph.pose_graph import GraphPrior
from terrafix.estimator.integrity.fragments import Fragment
from terrafix.estimator.integrity.yaw_gauge import YawGauge
from terrafix.estimator.keyframe_substitution import KeyframeSubstitution
from terrafix.estimator.measurements.attitude_height import DEFAULT_AGL_M, DEFAULT_AGL_SIGMA_M, UNKNOWN_RAD
from terrafix.estimator.measurements.telemetry_buffer import UNKNOWN_ATTITUDE_RAD, Attitude
from terrafix.estimator.models.bias_walk import walk_sigmas
from terrafix.estimator.models.lens_prior import radial_k1_sigma
from terrafix.estimator.models.motion_model import (
    MotionIncrement,
    predict_covariance,
    stationary_motion_cov,
    unknown_motion_cov,
)
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.state import (
    CALIBRATION_SIZE,
    DELTA_MOTION,
    DELTA_P,
    HEADING,
    HEIGHT,
    HORIZONTAL,
    LOG_HEIGHT_SCALE,
    MOTION_SIZE,
    VELOCITY,
    WORLD_POSITION,
    WORLD_ROTATION,
    NodeState,
)
from terrafix.messages import Origin

STARTS_MOVING = 3  # frames: one may show what wind or wash moves [spec: MIN_CONSISTENT, map_update.py]
FLYING_M = 20.0  # above the ground: a vehicle that is seen to move there has taken off [tuned]
# What an autopilot's own sigma leaves out: a compass beside motors and wires, a barometer over ground that is higher or
# lower than at take-off. On real flights the heading was 12 degrees and the height 8 % away from the log, and a compass
# that is 15 degrees off must still be inside the search (1.5 sigma).
COMPASS_BIAS_RAD = np.radians(10.0)  # [measured: docs/search.md]
HEIGHT_BIAS = 0.05  # of the height [tuned]
TAKE_OFF_AWAY = 5.0  # heights: from the take-off to the first frame in the air, a climb at 20 % [tuned]

CalibrationState = tuple[np.ndarray, np.ndarray]  # B (6,) and its covariance (6, 6)


class ResetReason(StrEnum):
    """Why a graph begins."""

    FIRST_FRAME = "first frame"
    FIRST_TELEMETRY = "the autopilot's first heading or height"
    HEADING_GATE = "reported headings contradict the first one"
    HEIGHT_GATE = "reported heights contradict the first one"
    HEADING_KNOWN = "a heading is reported again"
    HEADING_UNKNOWN = "unseen motion without a reported heading"
    MOTION_TIMEOUT = "odometry contradicts velocity"
    VELOCITY = "odometry innovations of one sign"
    MOVING_START = "seen to move as no standing vehicle does after its take-off"
    UNMEASURED_TAKE_OFF = "in flight after a take-off that nothing measured"
    TOO_LOW = "height below that of map matching"
    MAP_MATCH = "map match"
    INDETERMINATE = "the graph was numerically indeterminate"


def reset(
    state: FilterState, frame_id: int, t_s: float, prior: GraphPrior, *, joined: bool = True, confirmed: bool = True
) -> int:
    """A new graph whose only node is the newest frame. -> its node. The nodes before stay as they were estimated.
    ``joined``: a measurement ties the frame to the flight; False: dead reckoning alone. ``confirmed``: its fragment
    belongs to the flight; False: images that contradict inertial readings may show another."""
    assert state.newest_odometry is not None
    state.keep_keyframes(state.graph.window)
    state.left.clear()  # the new graph may lie elsewhere
    state.motion_cov = prior.motion_cov
    node = state.first_node = state.graph.start(t_s, prior)
    state.covariances.started(node, prior)
    state.continuity = FrameContinuity(KeyframeSubstitution.of(state.newest_odometry))
    fragment = Fragment(t_s, state.newest_odometry.fragment_id, confirmed=confirmed, joined=joined)
    state.register_frame(node, frame_id, fragment)
    return node


def start_at(
    state: FilterState, frame: FrameInput, at_m: np.ndarray, sigma_m: float, calibration: CalibrationState | None = None
) -> FrameState:
    """A new graph at ``at_m`` (2,), east and north, known to ``sigma_m``: attitude and height as the autopilot reports
    them, nothing known of the velocity. ``calibration``: as estimated before; None: the prior of the description."""
    origin, attitude = state.origin, frame.attitude
    agl = DEFAULT_AGL_M if attitude.agl_m is None else attitude.agl_m
    agl_sigma = DEFAULT_AGL_SIGMA_M if attitude.agl_m is None else origin.agl_sigma_m
    bias, calibration_cov = calibration or (np.zeros(CALIBRATION_SIZE), _calibration_prior_cov(state, agl, agl_sigma))
    r_w_c = state.camera.expected(attitude, bias)
    up_m = state.terrain.ground_m + agl
    if origin.ground_amsl_m is not None and attitude.agl_m is not None:  # above the ground of the take-off
        up_m = origin.ground_amsl_m + attitude.agl_m
    if calibration is not None:  # the height in the graph, from the reported one above the barometer's zero
        reported_m = (origin.ground_amsl_m or 0.0) + agl - state.terrain.ground_m
        up_m = state.terrain.ground_m + reported_m * float(np.exp(-bias[LOG_HEIGHT_SCALE])) - float(bias[HEIGHT])
    pose = gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), np.array([*at_m, up_m]))
    cov = np.zeros((6, 6))
    cov[WORLD_POSITION, WORLD_POSITION] = np.diag([sigma_m, sigma_m, 3 * agl_sigma]) ** 2
    cov[WORLD_ROTATION, WORLD_ROTATION] = np.diag([1.0, 1.0, UNKNOWN_RAD]) ** 2
    state.yaw_gauge = YawGauge(at_m) if attitude.yaw_rad is None else None
    motion_cov = stationary_motion_cov() if attitude.stands else unknown_motion_cov()
    state.contradicted_images.inertial_cov = None
    node = NodeState(pose, bias, np.zeros(MOTION_SIZE))
    return _start(state, frame, node, (cov, calibration_cov, motion_cov), state.terrain.ground_m)


def continue_from(
    state: FilterState,
    frame: FrameInput,
    at_m: np.ndarray,
    velocity: np.ndarray,
    predicted_cov: np.ndarray,
    *,
    joined: bool,
    confirmed: bool = True,
) -> FrameState:
    """A new graph where the motion model predicts the camera, with the heading that is reported now, or with an
    unobservable one: a vehicle that was not seen may have turned, and the graph would take its course as a measurement
    of the turn.

    ``at_m`` (3,), ``velocity`` (8,), ``predicted_cov``: of position and velocity, without what the newest node has.
    ``joined``, ``confirmed``: as in ``reset``."""
    last, attitude = state.last, frame.attitude
    assert last is not None
    dt_s = frame.t_s - last.t_s
    before, calibration_cov = state.graph.state(last.node), state.covariances.calibration(last.node)
    r_before = before.pose.rotation().matrix()
    r_w_c = state.camera.expected(attitude, before.calibration, r_before)
    step, level = (at_m - before.pose.translation())[:2], np.diag([1.0, 1.0, 0.0])
    cov = tangent_to_world(last.cov, r_before)
    cov[WORLD_POSITION, WORLD_POSITION] += predicted_cov[DELTA_P, DELTA_P]
    if state.yaw_gauge is not None:  # the step is in gauge-fixed axes
        cov[WORLD_POSITION, WORLD_POSITION] += state.yaw_gauge.sigma_share**2 * float(step @ step) * level
    cov[WORLD_ROTATION, WORLD_ROTATION] += np.diag([UNKNOWN_ATTITUDE_RAD, UNKNOWN_ATTITUDE_RAD, UNKNOWN_RAD]) ** 2
    was = state.yaw_gauge or YawGauge(at_m[:2], 0.0)
    now = was.after_gap(dt_s, at_m[:2])
    state.yaw_gauge = now if attitude.yaw_rad is None else None
    rise_m = state.terrain.rise_sigma_m(float(np.hypot(*step)))
    calibration_cov += np.diag(walk_sigmas(dt_s, 0.0, rise_m) ** 2)
    motion_cov = predicted_cov[DELTA_MOTION, DELTA_MOTION].copy()
    motion_cov[VELOCITY, VELOCITY] += now.sigma_share**2 * float(velocity[:2] @ velocity[:2]) * level
    node = NodeState(gtsam.Pose3(gtsam.Rot3.ClosestTo(r_w_c), at_m), before.calibration, velocity)
    covs = cov, calibration_cov, motion_cov
    return _start(state, frame, node, covs, state.terrain.elevation_m(at_m), joined=joined, confirmed=confirmed)


def _start(
    state: FilterState,
    frame: FrameInput,
    first: NodeState,
    covs: tuple[np.ndarray, np.ndarray, np.ndarray],
    ground_m: float,
    *,
    joined: bool = True,
    confirmed: bool = True,
) -> FrameState:
    """A new graph with the reported attitude and height. ``covs``: of the pose (6, 6) in world axes, of B (6, 6) and of
    V (8, 8). ``ground_m``: AMSL, below the camera. ``joined``, ``confirmed``: as in ``reset``."""
    cov, calibration_cov, motion_cov = covs
    r_w_c = first.pose.rotation().matrix()
    gauge = state.yaw_gauge
    prior = GraphPrior(
        first,
        world_to_tangent(cov, r_w_c),
        calibration_cov,
        motion_cov,
        state.camera.factor(state.graph.next_keys(), frame.attitude, r_w_c, ground_m),
        world_to_tangent(cov if gauge is None else gauge.gauge_fixed_cov(cov), r_w_c),
    )
    reset(state, frame.frame_id, frame.t_s, prior, joined=joined, confirmed=confirmed)
    return state.refresh_newest()


def _calibration_prior_cov(state: FilterState, agl_m: float, agl_sigma_m: float) -> np.ndarray:
    """(6, 6) of B before anything was measured."""
    camera = state.origin.camera
    tolerance = np.radians(camera.mount_tolerance_deg)
    yaw = float(np.hypot(np.radians(state.origin.yaw_sigma_deg), COMPASS_BIAS_RAD))
    # The ground below, over that of the take-off. A barometer tells nothing of it.
    below_m = state.terrain.rise_sigma_m(TAKE_OFF_AWAY * max(agl_m, 0.0))
    height = float(np.linalg.norm([agl_sigma_m, HEIGHT_BIAS * agl_m, below_m]))
    return np.diag([tolerance, tolerance, yaw, height, radial_k1_sigma(camera), scale_sigma(camera)]) ** 2


@dataclass(frozen=True)
class InitialPose:
    """Where the first graph begins: ``at_m`` (2,) east and north, known to ``sigma_m``. ``way_m`` (2,),
    ``way_sigma_m``: the part of it that was flown since the prior. ``calibration``: as estimated before."""

    at_m: np.ndarray
    sigma_m: float
    way_m: np.ndarray
    way_sigma_m: float
    calibration: CalibrationState | None


class Initializer:
    """From a `NavPrior` to the first node.

    ``prior``: None: the start of the flight at the first frame."""

    def __init__(self, origin: Origin, prior: NavPrior | None) -> None:
        self._origin, self._prior = origin, prior
        self._has_heading = self._has_height = False

    def has_new_telemetry(self, attitude: Attitude) -> bool:
        """The autopilot's first heading or height came after the first frame."""
        heading = not self._has_heading and attitude.yaw_rad is not None
        return heading or (not self._has_height and attitude.agl_m is not None)

    def initialize(self, state: FilterState, frame: FrameInput) -> tuple[FrameState, InitialPose]:
        """The first graph, or that graph once more while no map match has been accepted."""
        initial = self.initial_pose(frame.t_s, frame.attitude, state.terrain)
        state.has_height = self._has_height
        assert self._prior is not None
        state.began_s = self._prior.t_s
        if self._prior.placed:
            state.on_placed()
        return start_at(state, frame, initial.at_m, initial.sigma_m, initial.calibration), initial

    def initial_pose(self, t_s: float, attitude: Attitude, terrain: Terrain) -> InitialPose:
        """The prior, moved on to ``t_s``."""
        self._has_heading, self._has_height = attitude.yaw_rad is not None, attitude.agl_m is not None
        self._prior = prior = self._prior or NavPrior.start(self._origin, t_s)
        if prior.ground is not None:
            terrain.update(prior.ground.plane, np.array(prior.ground.at_m))
        way_m, way_sigma_m = prior.path_until(t_s, attitude.of_vehicle.yaw_rad)
        sigma_m = float(np.hypot(prior.sigma_m, way_sigma_m))
        rise_m = terrain.rise_sigma_m(float(np.hypot(*way_m)) + way_sigma_m)
        calibration = _calibration_at(prior, t_s, attitude, rise_m)
        return InitialPose(prior.at_m + way_m, sigma_m, way_m, way_sigma_m, calibration)


def _calibration_at(prior: NavPrior, t_s: float, attitude: Attitude, rise_sigma_m: float) -> CalibrationState | None:
    """The calibration of a checkpoint, with its random walk since. None: there is none, or heading or height, which it
    refers to, are not reported now."""
    learnt = prior.learnt
    yaw_rad = attitude.of_vehicle.yaw_rad
    if learnt is None or prior.yaw_rad is None or yaw_rad is None or attitude.agl_m is None:
        return None
    turned_rad = math.remainder(yaw_rad - prior.yaw_rad, math.tau)
    sigmas = walk_sigmas(max(t_s - learnt.t_s, 0.0), turned_rad, rise_sigma_m)
    return learnt.error, learnt.cov + np.diag(sigmas**2)


class TakeOffDetector:
    """``launching``: the vehicle stood disarmed, and was not seen to fly since."""

    def __init__(self) -> None:
        self.launching = False
        # V (8,) and its covariance (8, 8) by inertial readings alone, since the vehicle stood. None: no readings.
        self._inertial: tuple[np.ndarray, np.ndarray] | None = None
        self._contradicted = 0  # frames in a row
        self._unmeasured = False  # a part of the take-off had no inertial readings either

    def stood(self) -> None:
        self.launching, self._contradicted = True, 0
        self._inertial = np.zeros(MOTION_SIZE), stationary_motion_cov()

    def start_off_mps(self, before: NodeState, increment: MotionIncrement | None, *, seen: bool) -> np.ndarray | None:
        """(2,) [m/s] by which velocity differs from that of a vehicle that stood on the ground, where it does so beyond
        what inertial readings leave open (chi-square, 99.9 %, in STARTS_MOVING frames in a row): disarmed is evidence
        for standing, but a vehicle on a deck stands on what moves. ``before``: the newest node, to which odometry
        belongs if ``seen``; ``increment``: from there on. None: it does not."""
        if self._inertial is None or increment is None:
            return None
        motion, cov = self._inertial
        off_mps = (before.motion - motion)[HORIZONTAL]
        distance2 = float(off_mps @ np.linalg.solve(cov[HORIZONTAL, HORIZONTAL], off_mps))
        self._contradicted = self._contradicted + 1 if seen and distance2 > GATE[2] else 0
        if self._contradicted >= STARTS_MOVING:
            self._inertial = None
            return np.asarray(off_mps)
        _, motion = increment.predict(np.zeros(3), motion, float(before.calibration[HEADING]))
        cov = predict_covariance(increment, cov)[DELTA_MOTION, DELTA_MOTION]
        self._inertial = (motion, cov) if increment.inertial else None
        return None

    def was_unmeasured(self, increment: MotionIncrement | None, seen_at_m: float | None) -> bool:
        """The vehicle is seen in flight after a take-off that neither images nor IMU measured. ``increment``: to the
        newest frame, None: it stands; ``seen_at_m``: its height above the ground, None: it was not seen."""
        if not self.launching or increment is None:
            return False
        self._unmeasured = self._unmeasured or not increment.inertial
        if seen_at_m is None or seen_at_m < FLYING_M:
            return False
        unmeasured, self.launching, self._unmeasured = self._unmeasured, False, False
        return unmeasured
