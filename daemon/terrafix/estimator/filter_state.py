"""What the parts of the estimator share, as `State` of OpenVINS does: graph, window and newest frame.

`Propagation` adds frames, `MapUpdate` adds map poses, `reset` begins a new graph. All work on one `FilterState`."""

import math
from array import array
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.covariances import Covariances
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.estimator.integrity.contradicted_images import ContradictedImages
from terrafix.estimator.integrity.fragments import Fragment, Fragments
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.yaw_gauge import YawGauge
from terrafix.estimator.keyframe_store import KeptKeyframe, KeyframeStore
from terrafix.estimator.keyframe_substitution import KeyframeSubstitution
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.measurements.attitude_height import MountedCamera
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.bias_walk import BAROMETER_SCALE_SIGMA, WALK_SIGMAS
from terrafix.estimator.models.lens_prior import radial_k1_sigma
from terrafix.estimator.models.motion_model import WorldAcceleration
from terrafix.estimator.models.speed_prior import SpeedPrior
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.monitors.image_orientation import OrientationMonitor
from terrafix.estimator.state import HEIGHT, LOG_HEIGHT_SCALE, MOTION_SIZE, RADIAL_K1, UP, VELOCITY
from terrafix.messages import Camera, CovarianceMode, LensEstimate, Odometry, Origin

# Time for which a frame that has left the window is known: the longest that the anchor works on a match.
LEFT_S = 90.0  # [spec: stuck_after_s of the anchor, processes.py]
LENS_SURE = 3.0  # sigmas, from which a lens distortion is applied: no lens has exactly none [tuned]


ImuQuery = Callable[[int, int], WorldAcceleration | None]  # of two times [ns]; None where readings do not cover them


def no_imu(_t0_ns: int, _t1_ns: int) -> None:
    """There are no inertial readings."""


@dataclass(frozen=True)
class FrameInput:
    """What is measured at a frame. ``imu(t0_ns, t1_ns)``: world acceleration between two times."""

    frame_id: int
    t_s: float
    odometry: Odometry
    attitude: Attitude
    imu: ImuQuery = no_imu


@dataclass(frozen=True)
class FrameState:
    """The camera at a frame: pose in the world, covariance (6, 6) in tangent order, velocity (3,) with covariance
    (3, 3) in ENU, and the node of the graph."""

    frame_id: int
    t_s: float
    pose: gtsam.Pose3
    cov: np.ndarray
    velocity_mps: np.ndarray
    velocity_cov: np.ndarray
    node: int


@dataclass(frozen=True)
class PastFrame:
    """A frame as it is, or was when it left the window: time, pose, and its covariance (6, 6) in tangent order."""

    t_s: float
    pose: gtsam.Pose3
    cov: np.ndarray


@dataclass
class FrameContinuity:
    """What ties the newest frame to the frames before it. A reset of the graph voids all of it.

    ``substitution``: for the keyframe of vision that the graph no longer has. ``last_increment_inertial``: whether the
    last motion increment came from inertial readings; None: there was none. ``stationary_node``: node at which a
    disarmed vehicle stands. ``keyframe_motion``: node of the keyframe of the newest odometry, and the position (3,) of
    the newest frame in that camera. ``inertial_since_fused``: inertial readings have measured all of the motion since
    the last frame with fused odometry."""

    substitution: KeyframeSubstitution | None = None
    last_increment_inertial: bool | None = None
    stationary_node: int | None = None
    keyframe_motion: tuple[int, np.ndarray] | None = None
    inertial_since_fused: bool = True


class FilterState:
    """``last_fix_s``: time of the newest frame with an accepted map match; None: there is none.

    ``yaw_gauge``: None while the heading is observable. ``has_height``: the autopilot reported one when the graph
    began, at ``began_s``."""

    def __init__(self, origin: Origin, graph: PoseGraph | None = None, lens: LensEstimate | None = None) -> None:
        """``lens``: lens calibration of an estimator that ran before in this flight."""
        self.origin = origin
        self.graph = graph or PoseGraph()
        self.camera = MountedCamera(origin)
        self.terrain = Terrain(origin.ground_amsl_m or 0.0)
        self.covariances = Covariances(self.graph)
        self.principal_point = PrincipalPointFilter(origin.camera, lens)
        self.speed_prior = SpeedPrior()
        self.fragments = Fragments()
        self.fragment = Fragment.joined_at(0.0)  # of the newest frame
        self.keyframes = KeyframeStore()
        self.left: dict[int, PastFrame] = {}  # frames that have left the window since the graph began
        self.continuity = FrameContinuity()
        self.yaw_gauge: YawGauge | None = None
        self.last: FrameState | None = None  # newest frame
        self.last_fix_s: float | None = None
        # First node of the flight that a place stands behind: a start that is known, or a map match of its graph.
        self.first_placed_node: int | None = None
        self.start_moved = False  # the vehicle stood on what moves, and no map match has placed it since
        self.on_gimbal = False  # the camera is held by a gimbal
        self.first_node = 0  # of the present graph, since the last reset
        self.last_fused_s = 0.0  # time of the newest frame with fused odometry or an accepted map match
        self.has_height = False
        self.began_s = 0.0
        self.newest_odometry: Odometry | None = None  # as vision published it
        # Time of the newest implausible odometry, and by which it was off the prediction, east and north.
        self.image_jump: tuple[float, Innovation] | None = None  # None: none since a match
        self.contradicted_images = ContradictedImages()
        self.orientation = OrientationMonitor()
        self.motion_cov = np.zeros((MOTION_SIZE, MOTION_SIZE))  # of V of the newest node
        self.lens_sigma = radial_k1_sigma(origin.camera)  # of its radial coefficient
        self.node_of: dict[int, int] = {}  # frame -> node, for nodes in the window
        self.keyframe_of: dict[int, int] = {}  # node -> frame, of the keyframes among them
        self.frames = array("q")  # frame of each node since the flight began
        self.principal_point_jacobians = array("f")  # ... and its ``principal_point_jacobian`` (2, 2)
        self.fragment_ids = array("q")  # ... and its fragment

    @property
    def mode(self) -> CovarianceMode:
        return self.covariances.mode

    def covariance(self, node: int) -> np.ndarray:
        """Covariance (6, 6) of C_node, tangent order."""
        return self.covariances.pose(node)

    @property
    def is_placed(self) -> bool:
        """A place stands behind the newest estimate: a start that is known, or a map match."""
        return self.first_placed_node is not None

    def on_placed(self) -> None:
        """A place stands behind all nodes of the present graph."""
        self.start_moved = False
        if self.first_placed_node is None:
            self.first_placed_node = self.first_node

    def on_start_moved(self) -> None:
        """The start is no place: the vehicle was carried away from it."""
        self.first_placed_node, self.start_moved = None, True

    def add_factors(self, node: int, *factors: gtsam.NonlinearFactor) -> None:
        """Factors of the variables of ``node``, of a measurement that was accepted."""
        self.graph.add(*factors)
        self.covariances.measured(node, factors)

    def refresh_newest(self) -> FrameState:
        """To be called after the newest node was added, or factors were: sets ``last``, ``motion_cov`` and
        ``lens_sigma``. -> ``last``."""
        node = self.graph.newest
        self.motion_cov = self.covariances.motion(node)
        self.lens_sigma = float(np.sqrt(self.covariances.calibration(node)[RADIAL_K1, RADIAL_K1]))
        self.covariances.record(node)
        self.last = self.frame_state(node)
        return self.last

    def frame_state(self, node: int) -> FrameState:
        """Newest estimate of the frame of a node in the window; the velocity's covariance is that of the newest one."""
        state = self.graph.state(node)
        velocity, velocity_cov, cov = state.motion[:3], self.motion_cov[VELOCITY, VELOCITY], self.covariance(node)
        if self.yaw_gauge is not None:
            cov, velocity_cov = self.yaw_gauge.marginal_cov(state.pose, cov, velocity, velocity_cov)
        return FrameState(self.frames[node], self.graph.time_of(node), state.pose, cov, velocity, velocity_cov, node)

    def register_frame(self, node: int, frame_id: int, fragment: Fragment) -> None:
        """The newest node belongs to ``frame_id``, in ``fragment``."""
        pose = self.graph.state(node).pose
        if fragment.frames == 1 and not fragment.confirmed:
            fragment.start_m = pose.translation()[:2]
            fragment.start_cov_m2 = tangent_to_world(self.covariance(node), pose.rotation().matrix())[:2, :2]
        self.fragment = fragment
        self.fragments.add(node, fragment)
        self.fragments.retain({n for n in self.node_of.values() if self.graph.holds(n)} | {node})
        self.node_of = {frame: n for frame, n in self.node_of.items() if self.graph.holds(n)}
        self.node_of[frame_id] = node
        self.keyframe_of = {n: frame for n, frame in self.keyframe_of.items() if self.graph.holds(n)}
        becomes_keyframe = self.newest_odometry is not None and self.newest_odometry.becomes_keyframe
        if becomes_keyframe and self.yaw_gauge is None:  # poses in axes that were chosen are not kept
            self.keyframe_of[node] = frame_id
        self.frames.append(frame_id)
        self.principal_point_jacobians.extend(self.principal_point_jacobian(pose).ravel())
        self.fragment_ids.append(fragment.fragment_id)

    def fragment_of(self, frame_id: int) -> Fragment | None:
        """The fragment of a frame in the window; None: it has left the window, or is registered to no fragment."""
        node = self.node_of.get(frame_id)
        if node is None or not self.graph.holds(node) or self.fragments.of(node).fragment_id < 0:
            return None
        return self.fragments.of(node)

    def keyframe(self, frame_id: int) -> KeptKeyframe | None:
        """A keyframe in the window, with its newest estimate, or one that has left it; None: neither."""
        node = self.node_of.get(frame_id)
        if node is None or node not in self.keyframe_of or not self.graph.holds(node):
            return self.keyframes.get(frame_id)
        return self._keyframe_at(node)

    def _keyframe_at(self, node: int) -> KeptKeyframe:
        pose = self.graph.state(node).pose
        view = KeyframeView(pose, self.covariance(node), self.terrain.elevation_m(pose.translation()))
        return KeptKeyframe(view, self.fragments.of(node))

    def keep_keyframes(self, leaving: Iterable[int]) -> None:
        """The nodes ``leaving`` are about to leave the window."""
        for node in leaving:
            past = PastFrame(
                self.graph.time_of(node), self.graph.state(node).pose, self.covariances.recorded_pose(node)
            )
            self.left = {f: other for f, other in self.left.items() if past.t_s - other.t_s < LEFT_S}
            self.left[self.frames[node]] = past
            frame_id = self.keyframe_of.get(node)
            if frame_id is not None:
                self.keyframes.add(frame_id, self._keyframe_at(node))

    def principal_point_jacobian(self, pose: gtsam.Pose3) -> np.ndarray:
        """Jacobian (2, 2) of the camera position (east and north) with respect to the principal point [m per unit of
        normalised image coordinates]."""
        p = pose.translation()
        return np.asarray(self.terrain.height_above_m(p) * pose.rotation().matrix()[:2, :2])

    def body(self, frame: FrameState) -> np.ndarray:
        """R_w_b (3, 3) of a frame, with the estimated mount."""
        return self.camera.body(frame.pose.rotation().matrix(), self.graph.state(frame.node).calibration)

    def radial_k1(self, node: int) -> float:
        """Coefficient of the radial distortion beyond the camera's description; 0 where it is not significant."""
        radial_k1 = float(self.graph.state(node).calibration[RADIAL_K1])
        return radial_k1 if abs(radial_k1) > LENS_SURE * self.lens_sigma else 0.0

    @property
    def radial_k1_estimate(self) -> tuple[float, float]:
        """Coefficient of the radial distortion beyond the camera's description at the newest node, and its 1-sigma."""
        return float(self.graph.state(self.graph.newest).calibration[RADIAL_K1]), self.lens_sigma

    def height_scale(self, node: int) -> tuple[float, float]:
        """True height over the height in the graph, and its relative 1-sigma: the part of the estimated scale between
        barometer and images that the focal length explains."""
        focal = self.origin.camera.focal_sigma
        if not self.has_height:
            return 1.0, focal
        both = scale_sigma(self.origin.camera)
        log_scale = float(self.graph.state(node).calibration[LOG_HEIGHT_SCALE])
        return focal_scale(self.origin.camera, log_scale), focal * BAROMETER_SCALE_SIGMA / both

    @property
    def amsl_known(self) -> bool:
        """Heights are above mean sea level; else above the ground at the start, whose elevation is unknown."""
        return self.origin.ground_amsl_m is not None or self.terrain.has_dem

    def amsl(self, frame: FrameState) -> tuple[float, float]:
        """Height of the camera AMSL [m], and its 1-sigma beyond the covariance of the graph. Without a DEM the graph
        has the height above the ground that is seen, and the barometer tells how high that ground lies. With one,
        images and barometer are two measurements: where they differ by more than a barometer drifts, one of them is
        wrong (a lens that zooms, tree tops), and nothing says which."""
        p = frame.pose.translation()
        scale, sigma = self.height_scale(frame.node)
        if not self.has_height:
            return self._image_amsl(p, scale, sigma)
        drift_m = float(WALK_SIGMAS[HEIGHT] * np.sqrt(frame.t_s - self.began_s))
        node = self.graph.state(frame.node)
        if self.terrain.has_dem:
            amsl_m, sigma_m = self._image_amsl(p, scale, sigma)
            seen_m = node.barometric_up_m - self.terrain.elevation_m(p)
            stretched_m = float(np.expm1(node.calibration[LOG_HEIGHT_SCALE])) * seen_m
            apart_m = node.barometric_up_m + stretched_m - amsl_m
            beyond_m2 = max(apart_m**2 - self.origin.agl_sigma_m**2 - drift_m**2, 0.0)
            return amsl_m, math.hypot(sigma_m, math.sqrt(beyond_m2))
        seen_m = node.barometric_up_m - self.terrain.ground_m
        sigma_m = math.hypot(self.origin.agl_sigma_m, drift_m, sigma * seen_m)
        return self.terrain.ground_m + scale * seen_m, sigma_m

    def _image_amsl(self, p: np.ndarray, scale: float, sigma: float) -> tuple[float, float]:
        """AMSL height [m] of a camera at ``p`` (3,) above the ground below it, and its 1-sigma by the focal length."""
        ground_m = self.terrain.elevation_m(p)
        seen_m = float(p[UP]) - ground_m
        return ground_m + scale * seen_m, sigma * seen_m


def focal_scale(camera: Camera, log_height_scale: float) -> float:
    """True height over the height in the graph: the part of the estimated ratio of reported to observed heights, given
    as its logarithm, that an error of the focal length explains."""
    return float(np.exp((camera.focal_sigma / scale_sigma(camera)) ** 2 * log_height_scale))


def scale_sigma(camera: Camera) -> float:
    """1-sigma of the height scale before anything was measured."""
    return float(np.hypot(camera.focal_sigma, BAROMETER_SCALE_SIGMA))
