"""Visual odometry as a measurement: the motion of a frame over the ground since its keyframe, gated against the motion
model, and what three keyframes saw together."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from terrafix.core.geodesy import local_rotation_up
from terrafix.estimator.factors.three_view import ThreeViewConstraint, ThreeViewPose, three_view_constraint
from terrafix.estimator.filter_state import FilterState, FrameInput
from terrafix.estimator.integrity.contradicted_images import WrongVelocity
from terrafix.estimator.integrity.fragments import CONFIRM_LLR, Fragment, MotionEvidence
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.integrity.motion_gate import MotionInnovation
from terrafix.estimator.integrity.static_picture import StaticPicture, ViewChange
from terrafix.estimator.keyframe_view import KeyframeView
from terrafix.estimator.measurements.ground_plane_motion import plane_motion
from terrafix.estimator.measurements.heading import heading_innovation
from terrafix.estimator.measurements.keyframe_link import LinkMeasurement, by_link, refused
from terrafix.estimator.measurements.telemetry_buffer import UNKNOWN_ATTITUDE_RAD
from terrafix.estimator.models.motion_model import MotionIncrement, predict_covariance
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.monitors.image_orientation import ORIENTATIONS, Orientation
from terrafix.estimator.state import (
    DELTA_P,
    HEADING,
    HEIGHT,
    HORIZONTAL,
    RADIAL_K1,
    TRANSLATION,
    UP,
    VELOCITY,
    NodeState,
)
from terrafix.messages import CovarianceMode, Odometry, Verdict

# Verdicts on frames without a new view of the ground.
NO_NEW_VIEW = (Verdict.BAD_IMAGE, Verdict.OVERTAKEN, Verdict.STALLED, Verdict.NO_GROUND)
MAX_ODOMETRY_SPEED_MPS = 80.0  # faster than any drone that this is made for [spec: design limit]
HEADING_GATE = 3.0  # sigmas between the turn of a new fragment and the reported heading [tuned]


@dataclass(frozen=True)
class KeyframeMotion:
    """Motion of a frame since its keyframe, whose node is ``parent``, by ``odometry``."""

    parent: int
    motion: RelativePose
    odometry: Odometry


@dataclass(frozen=True)
class GatedOdometry:
    """Odometry of one frame. ``motion``: None without one. ``fused``: the same, if it enters the graph. ``fragment``:
    to which the frame belongs. ``local_step_m`` (2,): since the frame before, in a fragment that was not confirmed yet.
    ``innovation``: against the motion model, without what a manoeuvre explains, and ``motion_innovation`` with it; None
    where that predicts nothing. ``begins_disconnected``: the first frame of a fragment that is fused, while only dead
    reckoning ties the fragment to the flight."""

    verdict: Verdict
    motion: KeyframeMotion | None
    fragment: Fragment
    local_step_m: np.ndarray | None = None
    innovation: Innovation | None = None
    begins_disconnected: bool = False
    motion_innovation: MotionInnovation | None = None

    @property
    def fused(self) -> KeyframeMotion | None:
        return self.motion if self.verdict is Verdict.ACCEPTED else None


def without_ground(odometry: Odometry) -> Odometry:
    """Of a frame whose camera looks away from the ground: what it shows is no motion over it."""
    return Odometry(
        t_ns=odometry.t_ns, frame_id=odometry.frame_id, keyframe_id=odometry.frame_id, verdict=Verdict.NO_GROUND
    )


class OdometryMeasurement:
    """``gated`` of each frame, in order; then ``three_view`` of the same."""

    def __init__(self, state: FilterState) -> None:
        self._state = state
        self._static_picture, self._view_change = StaticPicture(), ViewChange()

    @property
    def static_since_s(self) -> float | None:
        """Time of the first of the frames in a row that show one view; None: the newest one shows another."""
        return self._static_picture.since_s

    def gated(self, frame: FrameInput, before: NodeState, increment: Callable[[], MotionIncrement]) -> GatedOdometry:
        """``before``: the newest node; ``increment()``: of the motion model, from there to the frame."""
        odometry, attitude, t_s = frame.odometry, frame.attitude, frame.t_s
        alone = Fragment(t_s, odometry.fragment_id)  # of a frame without odometry that is fused
        self._state.orientation.refuses = False
        if odometry.verdict in NO_NEW_VIEW:
            return GatedOdometry(odometry.verdict, None, alone)
        unchanged = self._view_change.is_unchanged(odometry)
        repeats = odometry.static or (unchanged and self._static_picture.is_repeating)
        answer = self._first_motion(odometry, frame)
        if isinstance(answer, Verdict):
            frozen = self._static_picture.is_frozen(t_s, attitude, static=repeats, is_moving=False)
            return GatedOdometry(Verdict.STALLED if frozen else answer, None, alone)
        state, parent = self._state, answer.parent
        fragment, keyframe = state.fragments.of(parent), state.graph.state(parent).pose
        fragment.fragment_id = odometry.fragment_id  # the fragment may begin at a frame that was registered to none
        moved_m = keyframe.rotation().matrix() @ answer.motion.p_m
        in_fragment_m = state.fragments.displacement_m(parent) + moved_m[:2]
        local_step_m = None if fragment.confirmed else in_fragment_m - fragment.displacement_m
        motion, innovation, was_confirmed = None, None, fragment.confirmed
        if attitude.stands or state.yaw_gauge is not None:  # nothing predicts the motion
            if self._static_picture.is_frozen(t_s, attitude, static=repeats, is_moving=False):
                return GatedOdometry(Verdict.STALLED, None, alone)
            fragment.confirmed = True
            fragment.joined = fragment.joined or attitude.stands
        else:
            motion = self._innovation(t_s, keyframe.translation() + moved_m, answer, before, increment())
            innovation, moves = motion.gated, not motion.allows_standstill
            repeats = repeats or (unchanged and not innovation.is_accepted)
            frozen = self._static_picture.is_frozen(t_s, attitude, static=repeats, is_moving=moves)
            if not frozen:
                self._weigh_orientation(answer, frame, before, motion)
            wrong = not innovation.is_accepted or state.orientation.fault is not None
            if frozen or wrong or self._is_flipped(answer, frame, before, motion):
                verdict = Verdict.STALLED if frozen else Verdict.IMPLAUSIBLE
                state.image_jump = None if frozen else (t_s, motion.horizontal)
                return GatedOdometry(verdict, None, alone, innovation=innovation, motion_innovation=motion)
            if not fragment.confirmed:
                self._weigh_fragment(fragment, frame, answer, before, motion, increment())
        verdict = Verdict.ACCEPTED if fragment.confirmed else Verdict.UNCONFIRMED
        fragment.displacement_m = in_fragment_m
        disconnected = fragment.confirmed and not was_confirmed and not fragment.joined
        return GatedOdometry(verdict, answer, fragment, local_step_m, innovation, disconnected, motion)

    def _weigh_orientation(
        self, seen: KeyframeMotion, frame: FrameInput, before: NodeState, innovation: MotionInnovation
    ) -> None:
        """Whether turned or mirrored images explain a motion that upright ones do not."""
        monitor, state = self._state.orientation, self._state
        if innovation.gated.is_accepted and not monitor.suspects:
            return

        def likelihood(motion: KeyframeMotion) -> float:
            keyframe = state.graph.state(seen.parent).pose
            shown_m = keyframe.rotation().matrix() @ (motion.motion.p_m - seen.motion.p_m)
            other = replace(innovation, residual_m=innovation.residual_m + shown_m)
            heading = heading_innovation(state, frame.attitude, seen.parent, motion.motion.r, before)
            return -0.5 * (other.with_manoeuvre.mahalanobis2 + heading.mahalanobis2)

        others: dict[Orientation, float | None] = {}
        for orientation in ORIENTATIONS:
            motion = self._relative_motion(orientation.righted(seen.odometry), frame)
            others[orientation] = likelihood(motion) if isinstance(motion, KeyframeMotion) else None
        monitor.add(likelihood(seen), others)

    def _is_flipped(
        self, seen: KeyframeMotion, frame: FrameInput, before: NodeState, innovation: MotionInnovation
    ) -> bool:
        """Whether the image has turned by a quarter or a half since its keyframe, and the vehicle has not: its reported
        heading goes on from the estimate."""
        state, attitude = self._state, frame.attitude
        if not innovation.inertial or attitude.yaw_rad is None:
            return False
        heading = heading_innovation(state, attitude, seen.parent, seen.motion.r, before)
        if heading.is_accepted:
            return False
        turned_rad, sigma_rad = float(heading.residual[0]), math.sqrt(float(heading.covariance[0, 0]))
        beyond_rad = math.remainder(turned_rad, 0.5 * math.pi)
        was_rad = state.camera.yaw_rad(before.pose.rotation().matrix())
        is_rad = state.camera.yaw_rad(state.camera.expected(attitude, before.calibration))
        goes_on = abs(math.remainder(is_rad - was_rad, math.tau)) < 0.25 * math.pi
        return goes_on and abs(turned_rad) > 0.25 * math.pi and abs(beyond_rad) <= HEADING_GATE * sigma_rad

    def _weigh_fragment(
        self,
        fragment: Fragment,
        frame: FrameInput,
        seen: KeyframeMotion,
        before: NodeState,
        innovation: MotionInnovation,
        increment: MotionIncrement,
    ) -> None:
        """Whether motion and turn of a fragment that is not confirmed are those of this flight."""
        state = self._state
        over_s = max(frame.t_s - state.graph.time_of(seen.parent), 1e-3)
        heading = heading_innovation(state, frame.attitude, seen.parent, seen.motion.r, before)
        turns_agree = heading.mahalanobis2 <= HEADING_GATE**2
        inertial = innovation.inertial and state.continuity.inertial_since_fused
        cov_m2 = innovation.cov_m2[HORIZONTAL, HORIZONTAL]
        motion = MotionEvidence(innovation.residual_m[HORIZONTAL], cov_m2, over_s, turns_agree, inertial)
        contradicted = state.contradicted_images.active
        evidence = self._of_contradicted(motion, frame, seen, before, increment) if contradicted else motion
        fragment.add_frame(frame.t_s, evidence, by_duration=not contradicted)
        if fragment.joined:
            state.contradicted_images.end()

    def _of_contradicted(
        self,
        evidence: MotionEvidence,
        frame: FrameInput,
        seen: KeyframeMotion,
        before: NodeState,
        increment: MotionIncrement,
    ) -> MotionEvidence | None:
        """``evidence`` of images that have contradicted inertial readings, by the velocity that these have had since
        before. None: they do not know it, or the images are as wrong as before."""
        contradicted = self._state.contradicted_images
        if contradicted.inertial_cov is None:
            return None
        velocity_m2ps2 = contradicted.inertial_cov[VELOCITY, VELOCITY][HORIZONTAL, HORIZONTAL]
        cov_m2 = self._innovation_cov(frame.t_s, seen, increment, contradicted.inertial_cov)[HORIZONTAL, HORIZONTAL]
        drifting = contradicted.inertial_cov.copy()  # with a velocity that is known: a difference may be indefinite
        drifting[VELOCITY, :] = drifting[:, VELOCITY] = 0.0
        noise_m2 = self._innovation_cov(frame.t_s, seen, increment, drifting)[HORIZONTAL, HORIZONTAL]
        yaw_rad = self._state.camera.yaw_rad(before.pose.rotation().matrix())
        turn = local_rotation_up(yaw_rad)[HORIZONTAL, HORIZONTAL]
        shown = WrongVelocity(
            turn @ evidence.residual_m / evidence.dt_s,
            turn @ noise_m2 @ turn.T / evidence.dt_s**2,
            turn @ before.motion[VELOCITY][HORIZONTAL],
        )
        if contradicted.right_llr(shown, turn @ velocity_m2ps2 @ turn.T) < CONFIRM_LLR:
            return None
        return replace(evidence, cov_m2=cov_m2, contradicted=True)

    def three_view(self, seen: KeyframeMotion) -> tuple[int, ThreeViewConstraint] | None:
        """The constraint of points that the keyframe before, the keyframe and the frame saw, and the node of the
        first; None: there are too few."""
        state, odometry = self._state, seen.odometry
        first = state.node_of.get(odometry.previous_keyframe_id)
        if not odometry.three_view or first is None or not state.graph.holds(first):
            return None
        before, middle = state.graph.state(first), state.graph.state(seen.parent)
        ground_m = state.terrain.elevation_m(middle.pose.translation())
        risen = 0.0 if state.terrain.has_dem else float(before.calibration[HEIGHT] - middle.calibration[HEIGHT])
        moved = gtsam.Pose3(before.pose.rotation(), before.pose.translation() + np.array([0.0, 0.0, risen]))
        guess = ThreeViewPose(
            middle.pose.between(moved),
            seen.motion.between,
            float(middle.pose.translation()[UP]) - ground_m,
            ground_m,
            float(middle.calibration[RADIAL_K1]),
        )
        triples, sigma_norm = np.array(odometry.three_view), odometry.three_view_sigma_norm
        constraint = three_view_constraint(triples, sigma_norm, guess, state.origin.camera.focal_sigma)
        if constraint is None:
            return None
        state.principal_point.update(triples, sigma_norm, constraint.at)
        return first, constraint

    def _innovation(
        self, t_s: float, p_m: np.ndarray, seen: KeyframeMotion, before: NodeState, increment: MotionIncrement
    ) -> MotionInnovation:
        """Innovation of a camera position ``p_m`` (3,) by odometry, against the motion model."""
        state = self._state
        predicted_m, _ = increment.predict(before.pose.translation(), before.motion, float(before.calibration[HEADING]))
        cov_m2 = self._innovation_cov(t_s, seen, increment, state.motion_cov)
        return MotionInnovation(p_m - predicted_m, cov_m2, state.graph.since_newest_s(t_s), increment.inertial)

    def _innovation_cov(
        self, t_s: float, seen: KeyframeMotion, increment: MotionIncrement, motion_cov: np.ndarray
    ) -> np.ndarray:
        """(3, 3) of ``_innovation``, world axes, with covariance ``motion_cov`` (8, 8) of V of the newest node."""
        state = self._state
        dt_s = state.graph.since_newest_s(t_s)
        cov_m2 = predict_covariance(increment, motion_cov)[DELTA_P, DELTA_P].copy()
        if not state.fragments.of(seen.parent).confirmed:  # the motion model alone led here from the keyframe
            since_s = t_s - state.graph.time_of(seen.parent)
            cov_m2 += motion_cov[VELOCITY, VELOCITY] * max(since_s**2 - dt_s**2, 0.0)
        r_w_c = state.graph.state(seen.parent).pose.rotation().matrix() @ seen.motion.r
        return np.asarray(cov_m2 + r_w_c @ seen.motion.cov[TRANSLATION, TRANSLATION] @ r_w_c.T)

    def links(self, seen: KeyframeMotion, frame: FrameInput) -> list[LinkMeasurement | FusionVerdict]:
        """The further keyframes of the frame, each with its motion or with the reason why there is none."""
        return [self._link(by_link(seen.odometry, i), seen, frame) for i in range(len(seen.odometry.links))]

    def _link(self, odometry: Odometry, seen: KeyframeMotion, frame: FrameInput) -> LinkMeasurement | FusionVerdict:
        state = self._state
        if state.mode is CovarianceMode.JACOBIAN:  # the gate needs marginals, which a hot computer does without
            return refused(odometry, Verdict.THROTTLED)
        answer = self._relative_motion(odometry, frame)
        if isinstance(answer, Verdict):
            return refused(odometry, answer)
        if answer.parent in state.graph.leaving:
            return refused(odometry, Verdict.STALE)
        if state.fragments.of(answer.parent) is not state.fragments.of(seen.parent):
            return refused(odometry, Verdict.UNCONFIRMED)
        return LinkMeasurement(odometry.keyframe_id, answer.parent, answer.motion, seen.parent, seen.motion)

    def _first_motion(self, odometry: Odometry, frame: FrameInput) -> KeyframeMotion | Verdict:
        """Motion since the keyframe, or since the first of the further keyframes that tells one; or why there is
        none."""
        answer = self._relative_motion(odometry, frame)
        for i in range(len(odometry.links)):
            if isinstance(answer, KeyframeMotion) or answer is Verdict.IMPLAUSIBLE:
                return answer
            answer = self._relative_motion(by_link(odometry, i), frame)
        return answer

    def _relative_motion(self, odometry: Odometry, frame: FrameInput) -> KeyframeMotion | Verdict:
        """Motion since the keyframe; or why there is none."""
        if odometry.verdict is not Verdict.ACCEPTED or not odometry.two_view:
            return Verdict.FEW_INLIERS if odometry.verdict is Verdict.ACCEPTED else odometry.verdict
        state = self._state
        parent = state.node_of.get(odometry.keyframe_id)
        if parent is None or not state.graph.holds(parent):
            return Verdict.STALE
        keyframe = state.graph.state(parent)
        p = keyframe.pose.translation()
        view = KeyframeView(keyframe.pose, state.covariances.recorded_pose(parent), state.terrain.elevation_m(p))
        newest = state.graph.state(state.graph.newest)
        onward = newest.motion[:3] * (odometry.t_ns * 1e-9 - state.graph.time_of(state.graph.newest))
        way_m = float(np.hypot(*(newest.pose.translation() + onward - p)[:2]))
        motion = plane_motion(state, view, odometry, self._expected_rotation(frame, keyframe), way_m)
        if isinstance(motion, Verdict):
            return motion
        dt_s = max(odometry.t_ns * 1e-9 - state.graph.time_of(parent), 1e-3)
        possible = float(np.linalg.norm(motion.p_m)) <= MAX_ODOMETRY_SPEED_MPS * dt_s + view.height_m
        return KeyframeMotion(parent, motion, odometry) if possible else Verdict.IMPLAUSIBLE

    def _expected_rotation(self, frame: FrameInput, keyframe: NodeState) -> tuple[np.ndarray, float]:
        """R_w_c (3, 3) of the frame by the reported attitude, and the 1-sigma of its tilt [rad]."""
        r_w_kf = keyframe.pose.rotation().matrix()
        if frame.attitude.pitch_rad is None or frame.attitude.roll_rad is None:
            return r_w_kf, UNKNOWN_ATTITUDE_RAD
        r_w_k = self._state.camera.expected(frame.attitude, keyframe.calibration, r_w_kf)
        tilt_rad = np.radians(max(self._state.origin.attitude_sigma_deg, 1.0))
        return r_w_k, float(np.hypot(tilt_rad, frame.attitude.stale * UNKNOWN_ATTITUDE_RAD))
