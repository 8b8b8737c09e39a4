"""From frame to frame: motion model, odometry, attitude and height become a new node of the graph and its factors."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.aiding import AID_SOURCES
from terrafix.estimator.filter_state import FilterState, FrameInput, FrameState, ImuQuery
from terrafix.estimator.graph.pose_graph import NewNode
from terrafix.estimator.initialization import Initializer, ResetReason, TakeOffDetector, continue_from, start_at
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation, ScalarInnovation
from terrafix.estimator.integrity.innovation_gate import InnovationGate
from terrafix.estimator.integrity.signed_innovations import SignedInnovations
from terrafix.estimator.integrity.time_offset import Turn
from terrafix.estimator.measurements.aid_source import AidSample, AidSource
from terrafix.estimator.measurements.attitude_height import TURN_UNSEEN_RAD, UNKNOWN_ATTITUDE_RAD
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning, DeadReckoningAid
from terrafix.estimator.measurements.heading import HEADING_GATE_SIGMAS, heading_innovation
from terrafix.estimator.measurements.height import (
    HEIGHT_GATE_SIGMAS,
    height_innovation,
    is_below_map_matching,
    reported_agl_m,
)
from terrafix.estimator.measurements.keyframe_link import KeyframeLink
from terrafix.estimator.measurements.odometry import KeyframeMotion, OdometryMeasurement, Sighting
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.bias_walk import walk_sigmas
from terrafix.estimator.models.motion_model import (
    STATIONARY_M,
    MotionIncrement,
    fuse_odometry_increment,
    integrate_motion,
    predict_covariance,
    replace_motion_covariance,
    unknown_motion_cov,
)
from terrafix.estimator.models.plane_motion import MatchedRays, RelativePose
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.state import (
    DELTA_MOTION,
    DELTA_P,
    HEADING,
    HORIZONTAL,
    MOTION_SIZE,
    TRANSLATION,
    UP,
    VELOCITY,
    WORLD_POSITION,
    NodeState,
)
from terrafix.messages import CovarianceMode, Verdict

STEP_SHARE = 0.04  # of a step: error of odometry over real ground, for the point mass filter of the anchor [tuned]
STEP_FLOOR_M = 0.5  # [tuned]
MOTION_TIMEOUT_S = 5.0  # of a vehicle with inertial aiding alone [spec: EKF2_NOAID_TOUT of PX4]


@dataclass(frozen=True)
class PropagationResult:
    """Result of ``advance``. ``verdict``: on the odometry of the frame. ``step_m`` (2,): east, north since the frame
    before, by odometry alone, and its 1-sigma. ``turn``: since the frame before, by images. ``verdicts``: on all
    measurements, and on a reset of the graph, in the order in which they were made. ``motion``: since the keyframe, by
    odometry, also of a fragment that is not confirmed; None: there is none, or a graph has begun with the frame."""

    verdict: Verdict
    placed: FrameState
    step_m: np.ndarray
    step_sigma_m: float
    turn: Turn | None = None
    verdicts: tuple[FusionVerdict, ...] = ()
    motion: KeyframeMotion | None = None

    @property
    def fused(self) -> bool:
        """Odometry has entered the graph."""
        return self.verdict is Verdict.ACCEPTED


@dataclass(frozen=True)
class _SeenPosition:
    """Position by odometry less the predicted one, ``off_m`` (3,), and covariance (3, 3) of the former, world axes."""

    off_m: np.ndarray
    cov_m2: np.ndarray


@dataclass
class _Step:
    """One frame before it is added to the graph. ``increment``: of the motion model since ``before``, the newest node;
    None: the vehicle stands. ``predicted_cov``: of position and velocity at its end, ``predicted_m`` (3,),
    ``predicted_motion`` (8,) of V."""

    frame: FrameInput
    before: NodeState
    sighting: Sighting
    increment: MotionIncrement | None
    predicted_cov: np.ndarray
    predicted_m: np.ndarray
    predicted_motion: np.ndarray
    turn: Turn | None = None
    verdicts: list[FusionVerdict] = field(default_factory=list)
    parent: int = -1
    motion: RelativePose | None = None
    pose: gtsam.Pose3 = field(default_factory=gtsam.Pose3)  # of the camera, as predicted
    seen: _SeenPosition | None = None
    step_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    step_sigma_m: float = 0.0

    @property
    def known(self) -> KeyframeMotion | None:
        """Odometry that enters the graph."""
        return self.sighting.fused

    @property
    def p_m(self) -> np.ndarray:
        return np.asarray(self.pose.translation())


class Propagation:
    """``advance`` with every frame, in order of time.

    ``prior``: where an estimator that ran before in this flight left off; None: the flight begins."""

    def __init__(self, state: FilterState, prior: NavPrior | None = None) -> None:
        self._state = state
        self._initializer = Initializer(state.origin, prior)
        self._odometry = OdometryMeasurement(state)
        self._take_off = TakeOffDetector()
        self._dead_reckoning = DeadReckoningAid(state)
        self._aids = (self._dead_reckoning, *(make_aid(state) for make_aid in AID_SOURCES))
        self._height_gate, self._heading_gate = InnovationGate(HEIGHT_GATE_SIGMAS), InnovationGate(HEADING_GATE_SIGMAS)
        self._motion_refused_s: float | None = None  # time of the first of the impossible motions in a row
        self._signed = SignedInnovations()  # of odometry that is fused

    def advance(self, frame: FrameInput) -> PropagationResult:
        """A new node for ``frame``, or a new graph that begins with it."""
        state = self._state
        state.newest_odometry = frame.odometry
        if state.continuity.substitution is not None:
            frame = replace(frame, odometry=state.continuity.substitution.applied(frame.odometry))
        if state.last is None:
            return self._initialize(frame, ResetReason.FIRST_FRAME)
        if state.last_fix_s is None and self._initializer.has_new_telemetry(frame.attitude):
            # No linear graph recovers from a heading that turns out to be 70 degrees off what was assumed.
            return self._initialize(frame, ResetReason.FIRST_TELEMETRY)
        before = state.graph.state(state.graph.newest)
        increment = functools.cache(lambda: self._increment(frame, before, seen=True))
        sighting = self._odometry.sighting(frame, before, increment)
        turn = self._odometry.turn(sighting)
        rejected = self._gate_heading(frame, sighting, before)
        if rejected is not None and self._heading_gate.should_reinitialise and state.last_fix_s is None:
            return self._initialize(frame, ResetReason.HEADING_GATE, rejected)
        if rejected is not None:
            frame = replace(frame, attitude=replace(frame.attitude, yaw_rad=None))
        step = self._predict(frame, before, sighting, increment if rejected is None else None)
        step.turn = turn
        step.verdicts = [FusionVerdict("odometry", sighting.verdict, sighting.innovation)]
        step.verdicts += [] if rejected is None else [rejected]
        if result := self._reset_before_fusion(step):
            return result
        self._apply_odometry(step)
        rejected = self._gate_height(step)
        if rejected is not None and self._height_gate.should_reinitialise and state.last_fix_s is None:
            return self._initialize(step.frame, ResetReason.HEIGHT_GATE, rejected)
        if rejected is not None:
            step.frame = replace(step.frame, attitude=replace(step.frame.attitude, agl_m=None))
            step.verdicts.append(rejected)
        if is_below_map_matching(state, step.frame.attitude, step.p_m):
            return self._reset_height(step)
        return self._add_node(step)

    def _predict(
        self,
        frame: FrameInput,
        before: NodeState,
        sighting: Sighting,
        seen_increment: Callable[[], MotionIncrement] | None,
    ) -> _Step:
        """Motion model. ``seen_increment``: the increment of a frame with odometry, where it is known already."""
        stands, seen = frame.attitude.stands, sighting.fused is not None
        if stands:
            self._take_off.stood()
        increment = None
        if not stands and seen and seen_increment is not None:
            increment = seen_increment()
        elif not stands:
            increment = self._increment(frame, before, seen=seen)
        cov = predict_covariance(increment, self._state.motion_cov)
        p_m, velocity = before.pose.translation(), np.zeros(MOTION_SIZE)
        if increment is not None:
            p_m, velocity = increment.predict(p_m, before.motion, float(before.calibration[HEADING]))
        return _Step(frame, before, sighting, increment, cov, p_m, velocity)

    def _increment(self, frame: FrameInput, before: NodeState, *, seen: bool) -> MotionIncrement:
        """Increment of the motion model, from ``before``, the newest node, to ``frame``. ``seen``: odometry is
        fused."""
        state, attitude = self._state, frame.attitude
        from_s = state.graph.time_of(state.graph.newest)
        measured = frame.imu(round(from_s * 1e9), round(frame.t_s * 1e9))
        r_w_c = before.pose.rotation().matrix()
        yaws = tuple(
            state.camera.yaw_rad(r) for r in (r_w_c, state.camera.expected(attitude, before.calibration, r_w_c))
        )
        return integrate_motion(
            state.graph.since_newest_s(frame.t_s),
            measured,
            (yaws[0], yaws[1]),
            float(before.calibration[HEADING]),
            state.speed_prior.speed_mps,
            float(np.hypot(np.radians(state.origin.attitude_sigma_deg), attitude.righted_rad)),
            same_source=state.continuity.last_increment_inertial is (measured is not None),
            launching=self._take_off.launching,
            velocity_observed=not seen
            and any(aid.observes_velocity(frame.t_s, before, attitude) for aid in self._aids),
        )

    def _reset_before_fusion(self, step: _Step) -> PropagationResult | None:
        """A new graph at the predicted pose, where the present one would be overconfident. None: no reset is due."""
        state, frame, verdict = self._state, step.frame, step.sighting.verdict
        if self._is_motion_timed_out(step.sighting, frame.t_s) and step.increment is not None:
            dt_s = state.graph.since_newest_s(frame.t_s)
            step.predicted_cov[DELTA_MOTION, DELTA_MOTION] = unknown_motion_cov()
            step.predicted_cov[DELTA_P, DELTA_P] += unknown_motion_cov()[VELOCITY, VELOCITY] * dt_s**2
            detail = f"odometry contradicts velocity for {MOTION_TIMEOUT_S:.0f} s"
            return self._continue(step, verdict, _reset_verdict(ResetReason.MOTION_TIMEOUT, detail))
        if self._is_velocity_wrong(step.sighting) and step.increment is not None:
            off_m, self._signed = self._signed.sum_m, SignedInnovations()
            step.predicted_cov[DELTA_MOTION, DELTA_MOTION] = unknown_motion_cov()
            step.predicted_cov[HORIZONTAL, HORIZONTAL] += np.outer(off_m, off_m)
            detail = f"odometry was {np.hypot(*off_m):.0f} m to one side of the prediction"
            return self._continue(step, verdict, _reset_verdict(ResetReason.VELOCITY, detail))
        above_m = None if step.known is None else float(step.predicted_m[UP]) - state.terrain.ground_m
        if self._take_off.was_unmeasured(step.increment, above_m):
            # With the speed known at both ends a graph would be too sure of the distance between them.
            r_w_c = step.before.pose.rotation().matrix()
            cov = tangent_to_world(state.covariance(state.graph.newest), r_w_c)
            sigma_m = _worst_sigma(cov[:2, :2] + step.predicted_cov[:2, :2])
            step_m = (step.predicted_m - step.before.pose.translation())[:2]
            placed = start_at(state, frame, step.predicted_m[:2], sigma_m)
            verdicts = (*step.verdicts, _reset_verdict(ResetReason.UNMEASURED_TAKE_OFF))
            return PropagationResult(Verdict.ACCEPTED, placed, step_m, sigma_m, verdicts=verdicts)
        return self._reset_yaw_gauge(step)

    def _reset_yaw_gauge(self, step: _Step) -> PropagationResult | None:
        """A new graph when the heading becomes known, or unobservable in motion without odometry. None: no reset."""
        gauge, heading_reported = self._state.yaw_gauge, step.frame.attitude.yaw_rad is not None
        unseen = step.known is None and step.increment is not None and not heading_reported
        if gauge is not None and heading_reported:
            return self._continue(step, step.sighting.verdict, _reset_verdict(ResetReason.HEADING_KNOWN))
        if unseen and (gauge is None or not gauge.unobserved):
            return self._continue(step, step.sighting.verdict, _reset_verdict(ResetReason.HEADING_UNKNOWN))
        if unseen and gauge is not None:  # an unseen stretch is one turn
            self._state.yaw_gauge = gauge.after_unobserved(self._state.graph.since_newest_s(step.frame.t_s))
        elif step.known is not None and gauge is not None:
            gauge.unobserved = False
        return None

    def _continue(self, step: _Step, verdict: Verdict, reset: FusionVerdict) -> PropagationResult:
        step_m = (step.predicted_m - step.before.pose.translation())[:2]
        joined = step.known is not None and step.sighting.fragment.joined
        placed = continue_from(
            self._state, step.frame, step.predicted_m, step.predicted_motion, step.predicted_cov, joined=joined
        )
        sigma_m, verdicts = _worst_sigma(step.predicted_cov[:2, :2]), (*step.verdicts, reset)
        return PropagationResult(verdict, placed, step_m, sigma_m, verdicts=verdicts)

    def _reset_height(self, step: _Step) -> PropagationResult:
        """A new graph at the reported height."""
        state = self._state
        assert state.last is not None
        cov = tangent_to_world(state.last.cov, step.before.pose.rotation().matrix())
        cov[WORLD_POSITION, WORLD_POSITION] += step.predicted_cov[DELTA_P, DELTA_P]
        p = step.p_m
        placed = start_at(state, step.frame, p[:2], _worst_sigma(cov[:2, :2]))
        seen_m, reported_m = state.terrain.height_above_m(p), reported_agl_m(state, step.frame.attitude, p)
        detail = f"height {seen_m:.0f} m, where {reported_m:.0f} m are reported"
        step.verdicts.append(_reset_verdict(ResetReason.TOO_LOW, detail))
        return self._result(step, placed)

    def _apply_odometry(self, step: _Step) -> None:
        """Sets the pose of the new node, by odometry or the motion model alone, and the step for the anchor's
        belief."""
        state, known = self._state, step.known
        if known is None:
            step.parent, step.motion = self._unseen_motion(step)
        else:
            step.parent, step.motion = known.parent, known.motion
        step.pose = state.graph.state(step.parent).pose.compose(step.motion.between)
        step.step_m = (step.p_m - step.before.pose.translation())[:2]
        step.step_sigma_m = STATIONARY_M if step.increment is None else _worst_sigma(step.predicted_cov[:2, :2])
        if known is not None:
            r_w_c = step.pose.rotation().matrix()
            seen = r_w_c @ known.motion.cov[TRANSLATION, TRANSLATION] @ r_w_c.T
            self._seen_step(step, known, seen)
            if step.increment is not None and not step.sighting.begins_disconnected:
                step.seen = _SeenPosition(step.p_m - step.predicted_m, seen)
                step.increment, step.predicted_cov, gained = fuse_odometry_increment(
                    step.increment, step.seen.off_m, step.predicted_cov, seen
                )
                # Otherwise a correct increment would fall in the robust tail of its factor (factors/motion.py).
                step.predicted_motion = step.predicted_motion + gained
        self._fragment_step(step)

    def _seen_step(self, step: _Step, known: KeyframeMotion, seen_m2: np.ndarray) -> None:
        """Sets the step over the ground by odometry, whose position has covariance ``seen_m2`` (3, 3), world axes.
        Without a DEM the height has a far larger sigma than the horizontal position."""
        keyframe, continuity = self._state.graph.state(step.parent).pose, self._state.continuity
        aside_m2 = float(np.linalg.eigvalsh(seen_m2[:2, :2])[-1])
        if continuity.keyframe_motion is not None and continuity.keyframe_motion[0] == step.parent:
            # Both by odometry: against the estimate of the frame before, an error of the motion since the keyframe
            # would be in the step of every frame of it, and add up in the belief that follows these steps.
            step.step_m = (step.p_m - keyframe.transformFrom(continuity.keyframe_motion[1]))[:2]
            if known.motion.rays is not None:
                # A height error scales the whole distance since the keyframe; the frame before contains its share.
                way_m2 = float(np.sum((step.p_m - keyframe.translation())[:2] ** 2))
                scale2 = known.motion.rays.ground.translation_scale_sigma**2
                aside_m2 = max(aside_m2 - way_m2 * scale2, 0.0) + float(step.step_m @ step.step_m) * scale2
        step.step_sigma_m = float(np.hypot(STEP_FLOOR_M + STEP_SHARE * np.hypot(*step.step_m), np.sqrt(aside_m2)))

    def _fragment_step(self, step: _Step) -> None:
        """The step for the anchor's belief follows the images, also those of a fragment that is not confirmed."""
        state, sighting = self._state, step.sighting
        last = state.fragment
        if sighting.fragment is last and sighting.local_step_m is not None:
            length_m = float(np.hypot(*sighting.local_step_m))
            step.step_m, step.step_sigma_m = sighting.local_step_m, STEP_FLOOR_M + STEP_SHARE * length_m
            return
        if sighting.fragment is last or last.confirmed or state.last is None:
            return
        # A fragment ends that nothing has confirmed: the belief returns to where it began, and continues from there.
        cov = tangent_to_world(state.last.cov, state.last.pose.rotation().matrix())[:2, :2]
        grown_m2 = max(float(np.linalg.eigvalsh(cov - last.start_cov_m2)[-1]), 0.0)
        step.step_m = step.p_m[:2] - last.start_m - last.displacement_m
        step.step_sigma_m = float(np.hypot(step.step_sigma_m, np.sqrt(grown_m2)))

    def _unseen_motion(self, step: _Step) -> tuple[int, RelativePose]:
        """-> parent node and motion from it, of a frame without odometry: by the motion model, with the heading of the
        compass. A stationary vehicle has the node at which it stopped as parent: a long pause is one motion from there,
        not a chain of short ones."""
        state, attitude, stands = self._state, step.frame.attitude, step.increment is None
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
        cov[TRANSLATION, TRANSLATION] = r_w_c.T @ step.predicted_cov[DELTA_P, DELTA_P] @ r_w_c
        moved_m = np.zeros(3) if stands else step.predicted_m - node.pose.translation()
        return parent, RelativePose(r_parent.T @ r_w_c, r_parent.T @ moved_m, cov)

    def _add_node(self, step: _Step) -> PropagationResult:
        """The frame enters the graph, with attitude, height, motion increment and odometry."""
        state, frame, p = self._state, step.frame, step.p_m
        assert step.motion is not None
        dt_s = state.graph.since_newest_s(frame.t_s)
        r_w_c, ground_m = step.pose.rotation().matrix(), state.terrain.elevation_m(p)
        attitude = state.camera.factor(state.graph.next_keys(), frame.attitude, r_w_c, ground_m, dt_s)
        rise_m = state.terrain.rise_sigma_m(float(np.hypot(*step.step_m)))
        increment = step.increment
        # No velocity bridge: what the fragment tells of its velocity says nothing of the way that was not seen.
        motion_cov = step.predicted_cov[DELTA_MOTION, DELTA_MOTION] if step.sighting.begins_disconnected else None
        if increment is not None:
            increment = replace(increment, terrain_unknown=not state.terrain.has_dem)
            if step.known is not None:
                increment = increment.in_height_units(max(float(p[UP]) - ground_m, 1.0), ground_m)
        three = None if step.known is None else self._odometry.three_view(step.known)
        first = NodeState(step.pose, step.before.calibration, step.predicted_motion)
        motion, links = self._linked(step)
        new = NewNode(first, step.parent, motion, increment, attitude, rise_m, three, motion_cov, links)
        state.keep_keyframes(state.graph.leaving)
        walk, parent = self._walk_sigmas(step), state.graph.state(step.parent)
        node = state.graph.extend(frame.t_s, new)
        state.motion_cov = self._motion_cov(step)
        state.covariances.extended(new, parent, walk, state.motion_cov)
        self._continuity_of(step, node)
        state.register_frame(node, frame.frame_id, step.sighting.fragment)
        step.verdicts += self._fuse_aids(step, node, dt_s)
        last = state.refresh_newest()
        if step.known is not None:
            state.last_seen_s = frame.t_s
            state.speed_prior.update(frame.t_s, last.velocity_mps, last.velocity_cov)
            for aid in self._aids:
                aid.after_frame(last, frame.attitude)
        return replace(self._result(step, last), motion=step.sighting.motion)

    def _linked(self, step: _Step) -> tuple[RelativePose, tuple[tuple[int, MatchedRays], ...]]:
        """The motion since the parent, and node and matched rays of each further keyframe that agrees with it."""
        assert step.motion is not None
        accepted = list[tuple[int, MatchedRays]]()
        for link in [] if step.known is None else self._odometry.links(step.known, step.frame):
            verdict = link if isinstance(link, FusionVerdict) else link.verdict(self._state)
            step.verdicts.append(verdict)
            if isinstance(link, KeyframeLink) and verdict.verdict is Verdict.ACCEPTED:
                assert link.motion.rays is not None
                accepted.append((link.keyframe, link.motion.rays))
        if not accepted or step.motion.rays is None:
            return step.motion, ()
        count = 1 + len(accepted)
        shared = replace(step.motion, rays=step.motion.rays.sharing(count))
        return shared, tuple((keyframe, rays.sharing(count)) for keyframe, rays in accepted)

    def _motion_cov(self, step: _Step) -> np.ndarray:
        """Covariance (8, 8) of V of the newest node by the motion model and odometry. A motion factor that has less
        weight in the graph has it here, too."""
        state, predicted_cov = self._state, step.predicted_cov
        if state.mode is CovarianceMode.JACOBIAN and step.seen is not None and step.increment is not None:
            increment = replace(step.increment, cov=step.increment.cov / state.graph.motion_weight)
            predicted_cov = predict_covariance(increment, state.motion_cov)
            _, predicted_cov, _ = fuse_odometry_increment(increment, step.seen.off_m, predicted_cov, step.seen.cov_m2)
        return predicted_cov[DELTA_MOTION, DELTA_MOTION]

    def _walk_sigmas(self, step: _Step) -> np.ndarray:
        """1-sigma (6,) of the change of B since the parent."""
        state, parent = self._state, self._state.graph.state(step.parent).pose
        turned = step.pose.rotation().compose(parent.rotation().inverse())
        rise_m = state.terrain.rise_sigma_m(float(np.hypot(*(step.p_m - parent.translation())[:2])))
        dt_s = state.graph.since_s(step.parent, step.frame.t_s)
        return walk_sigmas(dt_s, float(gtsam.Rot3.Logmap(turned)[UP]), rise_m)

    @staticmethod
    def _result(step: _Step, placed: FrameState) -> PropagationResult:
        verdict, verdicts = step.sighting.verdict, tuple(step.verdicts)
        return PropagationResult(verdict, placed, step.step_m, step.step_sigma_m, step.turn, verdicts)

    def _continuity_of(self, step: _Step, node: int) -> None:
        continuity = self._state.continuity
        continuity.last_increment_inertial = None if step.increment is None else step.increment.inertial
        if not step.frame.attitude.stands:
            continuity.stationary_node = None
        elif continuity.stationary_node is None:
            continuity.stationary_node = node
        known = step.known
        measured = step.increment is None or step.increment.inertial
        continuity.unseen_inertial = known is not None or (continuity.unseen_inertial and measured)
        continuity.keyframe_motion = None if known is None else (known.parent, known.motion.p_m)

    def _fuse_aids(self, step: _Step, node: int, dt_s: float) -> list[FusionVerdict]:
        """Measurements beside odometry, in the order of the table."""
        frame, state, verdicts = step.frame, self._state, list[FusionVerdict]()
        observed = step.known is not None or step.increment is None
        sample = AidSample(node, frame.t_s, frame.attitude, frame.imu, dt_s, observed)
        for aid in self._aids:
            verdict = self._fuse_aid(aid, sample)
            if verdict is None:
                continue
            verdicts.append(verdict)
            if aid.leads_step and not observed and verdict.verdict is Verdict.ACCEPTED:
                moved = state.graph.state(node).pose.translation() - step.before.pose.translation()
                cov = replace_motion_covariance(step.predicted_cov, state.motion_cov)
                step.step_m, step.step_sigma_m = moved[:2], _worst_sigma(cov[:2, :2])
        return verdicts

    def _fuse_aid(self, aid: AidSource, sample: AidSample) -> FusionVerdict | None:
        """Verdict on the measurement of ``aid`` for this frame; None: it has none there."""
        measurement = aid.measurement(sample)
        if measurement is None:
            return None
        fusion = fuse(self._state, sample.node, measurement)
        aid.on_fused(sample, fusion.verdict)
        return fusion

    # --- gates ---------------------------------------------------------------------------------------------------

    def _gate_heading(self, frame: FrameInput, sighting: Sighting, before: NodeState) -> FusionVerdict | None:
        """The reported heading against the turn that odometry saw. -> the verdict on a heading that is rejected."""
        state, known = self._state, sighting.fused
        if known is None or frame.attitude.yaw_rad is None or frame.attitude.stands or state.yaw_gauge is not None:
            return None
        innovation = heading_innovation(state, frame.attitude, known.parent, known.motion.r, before)
        return self._rejection("attitude", self._heading_gate, innovation)

    def _gate_height(self, step: _Step) -> FusionVerdict | None:
        """The reported height against the predicted one. -> the verdict on a height that is rejected."""
        state, attitude = self._state, step.frame.attitude
        if attitude.agl_m is None or attitude.stands:
            return None
        climb_m2 = float(step.predicted_cov[UP, UP])
        innovation = height_innovation(state, attitude.agl_m, step.p_m, step.before, climb_m2)
        return self._rejection("height", self._height_gate, innovation)

    def _rejection(self, name: str, gate: InnovationGate, innovation: ScalarInnovation) -> FusionVerdict | None:
        """The verdict on a scalar that ``gate`` rejects; None: it is accepted."""
        residual, sigma = innovation.residual, innovation.sigma
        if not gate.rejects(residual, sigma, self._state.last_fix_s):
            return None
        return FusionVerdict(name, Verdict.IMPLAUSIBLE, Innovation.scalar(residual, sigma, gate.gate_sigmas))

    def _is_velocity_wrong(self, sighting: Sighting) -> bool:
        """Whether the innovations of odometry have kept one sign for so long that velocity is what is wrong."""
        innovation = sighting.motion_innovation
        if sighting.fused is None or innovation is None or sighting.begins_disconnected:
            return False
        self._signed.add(innovation.residual_m[HORIZONTAL], innovation.cov_m2[HORIZONTAL, HORIZONTAL])
        return self._signed.alarm

    def _is_motion_timed_out(self, sighting: Sighting, t_s: float) -> bool:
        """Whether impossible motions have gone on for so long that velocity may be what is wrong."""
        if sighting.verdict is not Verdict.IMPLAUSIBLE:
            self._motion_refused_s = None
            return False
        self._motion_refused_s = t_s if self._motion_refused_s is None else self._motion_refused_s
        if t_s - self._motion_refused_s < MOTION_TIMEOUT_S:
            return False
        self._motion_refused_s = None  # velocity is unknown from here on: the next one has its own time
        return True

    # --- dead reckoning of the autopilot ---------------------------------------------------------------------------

    @property
    def dead_reckoned_s(self) -> float:
        """Time of the frame that the autopilot's dead reckoning has placed; 0: there is none."""
        return self._dead_reckoning.placed_s

    def add_dead_reckoning(self, reckoned: DeadReckoning, attitude: Attitude | None, imu: ImuQuery) -> bool:
        """How the autopilot moved by its own sensors while this estimator was not running. -> whether the newest frame,
        whose ``attitude`` is given, is placed by it."""
        self._dead_reckoning.add(reckoned)
        state, last = self._state, self._state.last
        if last is None or attitude is None:
            return False
        sample = AidSample(last.node, last.t_s, attitude, imu, 0.0, True)
        fused = self._fuse_aid(self._dead_reckoning, sample)
        if fused is None or fused.verdict is not Verdict.ACCEPTED:
            return False
        state.refresh_newest()
        return True

    def _initialize(
        self, frame: FrameInput, reason: ResetReason, rejected: FusionVerdict | None = None
    ) -> PropagationResult:
        """``rejected``: verdict that led to it, if the reason is a gate."""
        state = self._state
        self._height_gate.accept_initial()
        self._heading_gate.accept_initial()
        placed, initial = self._initializer.initialize(state, frame)
        state.keyframes.clear()  # what was assumed for them has turned out to be wrong
        sample = AidSample(placed.node, frame.t_s, frame.attitude, frame.imu, 0.0, True)
        fused = self._fuse_aid(self._dead_reckoning, sample)
        placed = state.refresh_newest()
        verdicts = [FusionVerdict("odometry", Verdict.ACCEPTED)]
        verdicts += [_reset_verdict(reason)] if rejected is None else [rejected, _reset_verdict(reason)]
        verdicts += [] if fused is None else [fused]
        way_m, sigma_m = initial.way_m, initial.way_sigma_m
        return PropagationResult(Verdict.ACCEPTED, placed, way_m, sigma_m, verdicts=tuple(verdicts))


def _reset_verdict(reason: ResetReason, detail: str = "") -> FusionVerdict:
    return FusionVerdict("reset", Verdict.ACCEPTED, None, detail or reason.value)


def _worst_sigma(cov: np.ndarray) -> float:
    """1-sigma along the longest axis of ``cov``."""
    return float(np.sqrt(np.linalg.eigvalsh(cov)[-1]))
