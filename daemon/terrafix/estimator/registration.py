"""Second phase of a frame: its pose, by odometry or by the motion model alone, and the step for the anchor's belief.

It follows the prediction and comes before the frame enters the graph (propagation.py). "Fused" is odometry that enters
the graph."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState, FrameInput
from terrafix.estimator.integrity.fragments import STEP_SHARE
from terrafix.estimator.measurements.odometry import GatedOdometry, KeyframeMotion
from terrafix.estimator.measurements.telemetry_buffer import TURN_UNSEEN_RAD, UNKNOWN_ATTITUDE_RAD
from terrafix.estimator.models.motion_model import STATIONARY_M, MotionIncrement, fuse_odometry_increment
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.state import DELTA_P, TRANSLATION, NodeState

STEP_FLOOR_M = 0.5  # [tuned]


@dataclass(frozen=True)
class PredictedFrame:
    """A frame after the motion model. ``before``: the newest node; ``increment``: since ``before``, None: the vehicle
    stands; ``p_m`` (3,) and ``motion`` (8,), V, at its end, and ``cov`` (11, 11) of both."""

    frame: FrameInput
    before: NodeState
    odometry: GatedOdometry
    increment: MotionIncrement | None
    p_m: np.ndarray
    motion: np.ndarray
    cov: np.ndarray

    @property
    def step_m(self) -> np.ndarray:
        """(2,) since ``before``, east and north."""
        return np.asarray((self.p_m - self.before.pose.translation())[:2])


@dataclass(frozen=True)
class Step:
    """Over the ground since the frame before: ``moved_m`` (2,), east and north, and its 1-sigma."""

    moved_m: np.ndarray
    sigma_m: float


@dataclass(frozen=True)
class OdometryPosition:
    """Position by odometry less the predicted one, ``off_m`` (3,), and covariance (3, 3) of the former, world axes."""

    off_m: np.ndarray
    cov_m2: np.ndarray


@dataclass(frozen=True)
class RegisteredFrame:
    """A frame with its ``pose``: ``relative`` to the node ``parent``. ``predicted``: with fused odometry in its
    increment. ``position``: None where odometry and motion model are not compared."""

    predicted: PredictedFrame
    parent: int
    relative: RelativePose
    pose: gtsam.Pose3
    step: Step
    position: OdometryPosition | None

    @property
    def p_m(self) -> np.ndarray:
        return np.asarray(self.pose.translation())

    def without_height(self) -> "RegisteredFrame":
        frame = self.predicted.frame
        frame = replace(frame, attitude=replace(frame.attitude, agl_m=None))
        return replace(self, predicted=replace(self.predicted, frame=frame))


def register(state: FilterState, predicted: PredictedFrame) -> RegisteredFrame:
    """The pose of the new node, by fused odometry or the motion model alone."""
    odometry, fused, position = predicted.odometry, predicted.odometry.fused, None
    parent, relative = _by_motion_model(state, predicted) if fused is None else (fused.parent, fused.motion)
    pose = state.graph.state(parent).pose.compose(relative.between)
    p_m = np.asarray(pose.translation())
    moved_m = (p_m - predicted.before.pose.translation())[:2]
    step = Step(moved_m, STATIONARY_M if predicted.increment is None else worst_sigma(predicted.cov[:2, :2]))
    if fused is not None:
        r_w_c = pose.rotation().matrix()
        position_m2 = r_w_c @ fused.motion.cov[TRANSLATION, TRANSLATION] @ r_w_c.T
        step = _odometry_step(state, fused, p_m, moved_m, position_m2)
        if predicted.increment is not None and not odometry.begins_disconnected:
            position = OdometryPosition(p_m - predicted.p_m, position_m2)
            increment, cov, gained = fuse_odometry_increment(
                predicted.increment, position.off_m, predicted.cov, position_m2
            )
            # Otherwise a correct increment would fall in the robust tail of its factor (factors/motion.py).
            predicted = replace(predicted, increment=increment, cov=cov, motion=predicted.motion + gained)
    return RegisteredFrame(predicted, parent, relative, pose, _fragment_step(state, odometry, p_m, step), position)


def _odometry_step(
    state: FilterState, fused: KeyframeMotion, p_m: np.ndarray, moved_m: np.ndarray, position_m2: np.ndarray
) -> Step:
    """Step over the ground by odometry, whose position ``p_m`` has covariance ``position_m2`` (3, 3), world axes.
    ``moved_m`` (2,): since the estimate of the frame before. Without a DEM the height has a far larger sigma than the
    horizontal position."""
    keyframe, continuity = state.graph.state(fused.parent).pose, state.continuity
    aside_m2 = float(np.linalg.eigvalsh(position_m2[:2, :2])[-1])
    if continuity.keyframe_motion is not None and continuity.keyframe_motion[0] == fused.parent:
        # Both by odometry: against the estimate of the frame before, an error of the motion since the keyframe
        # would be in the step of every frame of it, and add up in the belief that follows these steps.
        moved_m = (p_m - keyframe.transformFrom(continuity.keyframe_motion[1]))[:2]
        if fused.motion.rays is not None:
            # A height error scales the whole distance since the keyframe; the frame before contains its share.
            way_m2 = float(np.sum((p_m - keyframe.translation())[:2] ** 2))
            scale2 = fused.motion.rays.ground.translation_scale_sigma**2
            aside_m2 = max(aside_m2 - way_m2 * scale2, 0.0) + float(moved_m @ moved_m) * scale2
    return Step(moved_m, float(np.hypot(STEP_FLOOR_M + STEP_SHARE * np.hypot(*moved_m), np.sqrt(aside_m2))))


def _fragment_step(state: FilterState, odometry: GatedOdometry, p_m: np.ndarray, step: Step) -> Step:
    """The step for the anchor's belief follows the images, also those of a fragment that is not confirmed,
    unless they have contradicted inertial readings."""
    last = state.fragment
    if state.contradicted_images.active:
        return step
    if odometry.fragment is last and odometry.local_step_m is not None:
        length_m = float(np.hypot(*odometry.local_step_m))
        return Step(odometry.local_step_m, STEP_FLOOR_M + STEP_SHARE * length_m)
    if odometry.fragment is last or last.confirmed or state.last is None:
        return step
    # A fragment ends that nothing has confirmed: the belief returns to where it began, and continues from there.
    cov = tangent_to_world(state.last.cov, state.last.pose.rotation().matrix())[:2, :2]
    grown_m2 = max(float(np.linalg.eigvalsh(cov - last.start_cov_m2)[-1]), 0.0)
    moved_m = p_m[:2] - last.start_m - last.displacement_m
    return Step(moved_m, float(np.hypot(step.sigma_m, np.sqrt(grown_m2))))


def _by_motion_model(state: FilterState, predicted: PredictedFrame) -> tuple[int, RelativePose]:
    """-> parent node and motion from it, of a frame without fused odometry: by the motion model, with the heading of
    the compass. A stationary vehicle has the node at which it stopped as parent, which the graph then keeps: a long
    pause is one motion from there, not a chain of short ones."""
    attitude, stands = predicted.frame.attitude, predicted.increment is None
    parent, stationary = state.graph.newest, state.continuity.stationary_node
    if stands and stationary is not None and state.graph.holds(stationary):
        parent = stationary
        state.graph.keep(parent)
    node = state.graph.state(parent)
    r_parent = node.pose.rotation().matrix()
    r_w_c = state.camera.expected(attitude, node.calibration, r_parent)
    reported_rad = np.hypot(np.radians(state.origin.yaw_sigma_deg), attitude.turned_rad)
    yaw_sigma = TURN_UNSEEN_RAD if attitude.yaw_rad is None else reported_rad
    turn = UNKNOWN_ATTITUDE_RAD + yaw_sigma
    cov = np.diag([turn, turn, turn, 0.0, 0.0, 0.0]) ** 2
    cov[TRANSLATION, TRANSLATION] = r_w_c.T @ predicted.cov[DELTA_P, DELTA_P] @ r_w_c
    moved_m = np.zeros(3) if stands else predicted.p_m - node.pose.translation()
    return parent, RelativePose(r_parent.T @ r_w_c, r_parent.T @ moved_m, cov)


def worst_sigma(cov: np.ndarray) -> float:
    """1-sigma along the longest axis of ``cov``."""
    return float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
