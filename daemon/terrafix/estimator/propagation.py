"""From frame to frame: motion model, odometry, attitude and height become a new node of the graph and its factors."""

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.aiding import AID_SOURCES
from terrafix.estimator.filter_state import FilterState, FrameInput, FrameState, ImuQuery
from terrafix.estimator.graph.pose_graph import NewNode
from terrafix.estimator.initialization import Initializer, ResetReason, TakeOffDetector, continue_from, start_at
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.integrity.innovation_gate import InnovationGate
from terrafix.estimator.integrity.velocity_doubt import KnownMotion, VelocityDoubt
from terrafix.estimator.measurements.aid_source import AidSample, AidSource
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.measurements.ekf_dead_reckoning import DeadReckoning, DeadReckoningAid
from terrafix.estimator.measurements.heading import heading_innovation
from terrafix.estimator.measurements.height import height_innovation, is_below_map_matching, reported_agl_m
from terrafix.estimator.measurements.keyframe_link import LinkMeasurement
from terrafix.estimator.measurements.odometry import GatedOdometry, KeyframeMotion, OdometryMeasurement
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.bias_walk import walk_sigmas
from terrafix.estimator.models.motion_model import (
    MotionIncrement,
    fuse_odometry_increment,
    integrate_motion,
    predict_covariance,
    replace_motion_covariance,
    unknown_motion_cov,
)
from terrafix.estimator.models.plane_motion import MatchedRays, RelativePose
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.registration import PredictedFrame, RegisteredFrame, Step, register, worst_sigma
from terrafix.estimator.state import (
    DELTA_MOTION,
    DELTA_P,
    DELTA_V,
    HEADING,
    HORIZONTAL,
    MOTION_SIZE,
    UP,
    VELOCITY,
    WORLD_POSITION,
    NodeState,
)
from terrafix.messages import CovarianceMode, Verdict


@dataclass(frozen=True)
class PropagationResult:
    """Result of ``advance``. ``verdict``: on the odometry of the frame. ``step_m`` (2,): east, north since the frame
    before, by odometry alone, and its 1-sigma. ``verdicts``: on all measurements, and on a reset of the graph, in the
    order in which they were made. ``motion``: since the keyframe, by odometry, also of a fragment that is not
    confirmed; None: there is none, or a graph has begun with the frame. ``off``: of fused odometry from the prediction,
    east and north; None: nothing predicts it."""

    verdict: Verdict
    placed: FrameState
    step_m: np.ndarray
    step_sigma_m: float
    verdicts: tuple[FusionVerdict, ...] = ()
    motion: KeyframeMotion | None = None
    off: Innovation | None = None

    @property
    def fused(self) -> bool:
        """Odometry has entered the graph."""
        return self.verdict is Verdict.ACCEPTED


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
        self._height_gate, self._heading_gate = InnovationGate("height"), InnovationGate("attitude")
        self._doubt = VelocityDoubt()

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
        increment = functools.cache(lambda: self._increment(frame, before, fused=True))
        odometry = self._odometry.gated(frame, before, increment)
        if self._odometry.static_since_s == frame.t_s:
            self._doubt.before_static = self._motion_of(before)
        rejected = self._gate_heading(frame, odometry, before)
        if rejected is not None and self._heading_gate.should_reinitialise and state.last_fix_s is None:
            return self._initialize(frame, ResetReason.HEADING_GATE, rejected)
        if rejected is not None:
            frame = replace(frame, attitude=replace(frame.attitude, yaw_rad=None))
        predicted = self._predict(frame, before, odometry, increment if rejected is None else None)
        verdicts = [FusionVerdict("odometry", odometry.verdict, odometry.innovation)]
        verdicts += [] if rejected is None else [rejected]
        if result := self._reset_before_fusion(predicted, verdicts):
            return result
        registered = register(state, predicted)
        rejected = self._gate_height(registered)
        if rejected is not None and self._height_gate.should_reinitialise and state.last_fix_s is None:
            return self._initialize(frame, ResetReason.HEIGHT_GATE, rejected)
        if rejected is not None:
            registered = registered.without_height()
            verdicts.append(rejected)
        elif is_below_map_matching(state, registered.predicted.frame.attitude, registered.p_m):
            return self._reset_height(registered, verdicts)
        return self._add_node(registered, verdicts)

    # --- prediction ----------------------------------------------------------------------------------------------

    def _predict(
        self,
        frame: FrameInput,
        before: NodeState,
        odometry: GatedOdometry,
        fused_increment: Callable[[], MotionIncrement] | None,
    ) -> PredictedFrame:
        """Motion model. ``fused_increment``: the increment of a frame with fused odometry, where it is known
        already."""
        stands, fused = frame.attitude.stands, odometry.fused is not None
        if stands:
            self._take_off.stood()
        increment = None
        if not stands and fused and fused_increment is not None:
            increment = fused_increment()
        elif not stands:
            increment = self._increment(frame, before, fused=fused)
        cov = predict_covariance(increment, self._state.motion_cov)
        p_m, motion = before.pose.translation(), np.zeros(MOTION_SIZE)
        if increment is not None:
            p_m, motion = increment.predict(p_m, before.motion, float(before.calibration[HEADING]))
        return PredictedFrame(frame, before, odometry, increment, p_m, motion, cov)

    def _increment(
        self, frame: FrameInput, before: NodeState, *, fused: bool, from_s: float | None = None
    ) -> MotionIncrement:
        """Increment of the motion model, from ``before``, the newest node, to ``frame``; of its motion since an earlier
        ``from_s``, if that is given. ``fused``: odometry enters the graph."""
        state, attitude = self._state, frame.attitude
        dt_s = state.graph.since_newest_s(frame.t_s) if from_s is None else frame.t_s - from_s
        from_s = state.graph.time_of(state.graph.newest) if from_s is None else from_s
        measured = frame.imu(round(from_s * 1e9), round(frame.t_s * 1e9))
        r_w_c = before.pose.rotation().matrix()
        yaws = tuple(
            state.camera.yaw_rad(r) for r in (r_w_c, state.camera.expected(attitude, before.calibration, r_w_c))
        )
        return integrate_motion(
            dt_s,
            measured,
            (yaws[0], yaws[1]),
            float(before.calibration[HEADING]),
            state.speed_prior.speed_mps,
            float(np.hypot(np.radians(state.origin.attitude_sigma_deg), attitude.of_vehicle.righted_rad)),
            same_source=state.continuity.last_increment_inertial is (measured is not None),
            launching=self._take_off.launching,
            velocity_observed=not fused
            and any(aid.observes_velocity(frame.t_s, before, attitude) for aid in self._aids),
        )

    # --- resets --------------------------------------------------------------------------------------------------

    def _reset_before_fusion(
        self, predicted: PredictedFrame, verdicts: list[FusionVerdict]
    ) -> PropagationResult | None:
        """A new graph at the predicted pose, where the present one would be overconfident. None: no reset is due."""
        state, frame, odometry, cov = self._state, predicted.frame, predicted.odometry, predicted.cov.copy()
        if self._has_fused_static(odometry) and predicted.increment is not None:
            return self._reset_standstill(predicted, verdicts)
        self._doubt.note(odometry.verdict, odometry.motion_innovation, frame.t_s)
        # Images that are known to be turned or mirrored explain impossible motions.
        timed_out = state.orientation.fault is None and self._doubt.is_timed_out(frame.t_s, state.last_fix_s)
        if timed_out and predicted.increment is not None:
            return self._reset_unknown_velocity(predicted, verdicts)
        if self._is_velocity_wrong(predicted) and predicted.increment is not None:
            return self._reset_velocity(predicted, verdicts)
        if (off_mps := self._start_off_mps(predicted)) is not None:
            return self._leave_start(predicted, off_mps, verdicts)
        above_m = None if odometry.fused is None else float(predicted.p_m[UP]) - state.terrain.ground_m
        if self._take_off.was_unmeasured(predicted.increment, above_m):
            # With the speed known at both ends a graph would be too sure of the distance between them.
            last_cov = tangent_to_world(state.covariance(state.graph.newest), predicted.before.pose.rotation().matrix())
            sigma_m = worst_sigma(last_cov[:2, :2] + cov[:2, :2])
            placed = start_at(state, frame, predicted.p_m[:2], sigma_m)
            verdicts = [*verdicts, _reset_verdict(ResetReason.UNMEASURED_TAKE_OFF)]
            return PropagationResult(Verdict.ACCEPTED, placed, predicted.step_m, sigma_m, verdicts=tuple(verdicts))
        return self._reset_yaw_gauge(predicted, verdicts)

    def _reset_unknown_velocity(self, predicted: PredictedFrame, verdicts: list[FusionVerdict]) -> PropagationResult:
        """A new graph where odometry has contradicted velocity for long."""
        state, refused = self._state, self._doubt.refused
        t_s, cov = predicted.frame.t_s, predicted.cov.copy()
        assert refused is not None
        contradicted_s = t_s - refused.since_s
        unknown_s = contradicted_s + state.graph.since_newest_s(t_s)
        cov[DELTA_MOTION, DELTA_MOTION] = unknown_motion_cov()
        cov[DELTA_P, DELTA_P] += unknown_motion_cov()[VELOCITY, VELOCITY] * unknown_s**2
        against = "inertial readings" if refused.inertial else "velocity"
        reset = _reset_verdict(ResetReason.MOTION_TIMEOUT, f"odometry contradicts {against} for {contradicted_s:.0f} s")
        self._doubt.on_unknown()
        if refused.inertial:
            state.contradicted_images.begin(predicted.cov[DELTA_MOTION, DELTA_MOTION])
        else:
            state.contradicted_images.end()
        return self._continue(replace(predicted, cov=cov), [*verdicts, reset], confirmed=not refused.inertial)

    def _reset_velocity(self, predicted: PredictedFrame, verdicts: list[FusionVerdict]) -> PropagationResult:
        """A new graph where odometry has been to one side of the prediction for frames. Either of the two is wrong. The
        velocity before these frames, and inertial readings since, are the prior, as wide as the images may be right,
        until places confirm these; without such readings velocity is unknown."""
        innovation, (off_m, before) = predicted.odometry.motion_innovation, self._doubt.take_run()
        assert innovation is not None
        if innovation.inertial:
            predicted, inertial_cov = self._with_velocity_of(predicted, before)
            self._state.contradicted_images.begin(inertial_cov)
        else:
            predicted = replace(predicted, cov=predicted.cov.copy())
            predicted.cov[DELTA_MOTION, DELTA_MOTION] = unknown_motion_cov()
            self._doubt.on_unknown()
        predicted.cov[HORIZONTAL, HORIZONTAL] += np.outer(off_m, off_m)
        detail = f"odometry was {np.hypot(*off_m):.0f} m to one side of the prediction"
        reset = _reset_verdict(ResetReason.VELOCITY, detail)
        return self._continue(predicted, [*verdicts, reset], confirmed=not innovation.inertial)

    def _reset_standstill(self, predicted: PredictedFrame, verdicts: list[FusionVerdict]) -> PropagationResult:
        """A new graph where images that are now known to be repeated have shown a standstill. The velocity before them
        is the prior, as wide as the vehicle may have stopped; its way since then is not known."""
        before = self._doubt.before_static
        assert before is not None
        self._doubt.before_static = None
        moving, _ = self._with_velocity_of(predicted, before)
        way_m = (moving.motion - predicted.motion)[VELOCITY][HORIZONTAL] * (predicted.frame.t_s - before.t_s)
        moving.cov[HORIZONTAL, HORIZONTAL] += np.outer(way_m, way_m)
        detail = f"repeated images have shown a standstill for up to {np.hypot(*way_m):.0f} m"
        return self._continue(moving, [*verdicts, _reset_verdict(ResetReason.VELOCITY, detail)])

    def _with_velocity_of(self, predicted: PredictedFrame, before: KnownMotion) -> tuple[PredictedFrame, np.ndarray]:
        """``predicted`` with the velocity of ``before`` and what the motion model has of the time since then; it is as
        uncertain as it differs from the predicted one. And the covariance (8, 8) of V without this difference."""
        cov = predicted.cov.copy()
        since = self._increment(predicted.frame, predicted.before, fused=False, from_s=before.t_s)
        _, motion = since.predict(predicted.p_m, before.motion, float(predicted.before.calibration[HEADING]))
        motion_cov = predict_covariance(since, before.cov)[DELTA_MOTION, DELTA_MOTION]
        cov[DELTA_MOTION, DELTA_MOTION] = motion_cov
        off_mps = (predicted.motion - motion)[VELOCITY]
        cov[DELTA_V, DELTA_V] += np.outer(off_mps, off_mps)
        return replace(predicted, cov=cov, motion=motion), motion_cov

    def _motion_of(self, newest: NodeState) -> KnownMotion:
        """Of the newest node."""
        return KnownMotion(self._state.graph.time_of(self._state.graph.newest), newest.motion, self._state.motion_cov)

    def _has_fused_static(self, odometry: GatedOdometry) -> bool:
        """Whether frames that show one view are known to be repeated with this one, and some of them are fused."""
        since_s = self._odometry.static_since_s
        if odometry.verdict is not Verdict.STALLED or since_s is None or self._doubt.before_static is None:
            return False
        return self._state.last_fused_s >= since_s

    def _start_off_mps(self, predicted: PredictedFrame) -> np.ndarray | None:
        if self._state.last_fix_s is not None:  # the map tells where it started
            return None
        seen = self._state.continuity.keyframe_motion is not None and predicted.odometry.motion is not None
        return self._take_off.start_off_mps(predicted.before, predicted.increment, seen=seen)

    def _leave_start(
        self, predicted: PredictedFrame, off_mps: np.ndarray, verdicts: list[FusionVerdict]
    ) -> PropagationResult:
        """The vehicle stood on what moves with ``off_mps`` (2,), for all that is known since the start: that is
        no place any more."""
        state, cov = self._state, predicted.cov.copy()
        way_m = float(np.hypot(*off_mps)) * (predicted.frame.t_s - state.began_s)
        cov[HORIZONTAL, HORIZONTAL] += way_m**2 * np.eye(2)
        state.on_start_moved()
        detail = f"{np.hypot(*off_mps):.1f} m/s at the take-off: the start may have moved by {way_m:.0f} m"
        reset = _reset_verdict(ResetReason.MOVING_START, detail)
        return self._continue(replace(predicted, cov=cov), [*verdicts, reset])

    def _reset_yaw_gauge(self, predicted: PredictedFrame, verdicts: list[FusionVerdict]) -> PropagationResult | None:
        """A new graph when the heading becomes known, or unobservable in motion without odometry. None: no reset."""
        gauge, heading_reported = self._state.yaw_gauge, predicted.frame.attitude.yaw_rad is not None
        fused = predicted.odometry.fused is not None
        drifts = not fused and predicted.increment is not None and not heading_reported
        if gauge is not None and heading_reported:
            return self._continue(predicted, [*verdicts, _reset_verdict(ResetReason.HEADING_KNOWN)])
        if drifts and (gauge is None or gauge.fused):
            return self._continue(predicted, [*verdicts, _reset_verdict(ResetReason.HEADING_UNKNOWN)])
        if drifts and gauge is not None:  # a stretch without odometry is one turn
            self._state.yaw_gauge = gauge.after_gap(self._state.graph.since_newest_s(predicted.frame.t_s))
        elif fused and gauge is not None:
            self._state.yaw_gauge = gauge.after_odometry()
        return None

    def _continue(
        self, predicted: PredictedFrame, verdicts: list[FusionVerdict], *, confirmed: bool = True
    ) -> PropagationResult:
        """``confirmed``: as in ``reset``."""
        odometry = predicted.odometry
        joined = confirmed and odometry.fused is not None and odometry.fragment.joined
        step_m = predicted.step_m
        placed = continue_from(
            self._state,
            predicted.frame,
            predicted.p_m,
            predicted.motion,
            predicted.cov,
            joined=joined,
            confirmed=confirmed,
        )
        sigma_m = worst_sigma(predicted.cov[:2, :2])
        return PropagationResult(odometry.verdict, placed, step_m, sigma_m, verdicts=tuple(verdicts))

    def _reset_height(self, registered: RegisteredFrame, verdicts: list[FusionVerdict]) -> PropagationResult:
        """A new graph at the reported height, or at an unknown one."""
        state, predicted, p = self._state, registered.predicted, registered.p_m
        assert state.last is not None
        cov = tangent_to_world(state.last.cov, predicted.before.pose.rotation().matrix())
        cov[WORLD_POSITION, WORLD_POSITION] += predicted.cov[DELTA_P, DELTA_P]
        placed = start_at(state, predicted.frame, p[:2], worst_sigma(cov[:2, :2]))
        known = predicted.frame.attitude.agl_m is not None
        other = f"{reported_agl_m(state, predicted.frame.attitude, p):.0f} m are reported" if known else "the ground is"
        detail = f"height {state.terrain.height_above_m(p):.0f} m, where {other}"
        verdicts = [*verdicts, _reset_verdict(ResetReason.TOO_LOW, detail)]
        return _result(predicted, placed, registered.step, verdicts)

    # --- the new node ----------------------------------------------------------------------------------------------

    def _add_node(self, registered: RegisteredFrame, verdicts: list[FusionVerdict]) -> PropagationResult:
        """The frame enters the graph, with attitude, height, motion increment and odometry.

        The order matters: all that is read of the graph without the node comes before ``extend``, which drops the nodes
        that leave; covariances follow the graph; aids need the registered node; the state is refreshed after the last
        factor."""
        state, predicted, frame, p = self._state, registered.predicted, registered.predicted.frame, registered.p_m
        fused, increment = predicted.odometry.fused, predicted.increment
        dt_s = state.graph.since_newest_s(frame.t_s)
        r_w_c, ground_m = registered.pose.rotation().matrix(), state.terrain.elevation_m(p)
        attitude = state.camera.factor(state.graph.next_keys(), frame.attitude, r_w_c, ground_m, dt_s)
        rise_m = state.terrain.rise_sigma_m(float(np.hypot(*registered.step.moved_m)))
        # No velocity bridge: what the fragment tells of its velocity says nothing of the way before it.
        motion_cov = predicted.cov[DELTA_MOTION, DELTA_MOTION] if predicted.odometry.begins_disconnected else None
        if increment is not None:
            increment = replace(increment, terrain_unknown=not state.terrain.has_dem)
            if fused is not None:
                increment = increment.in_height_units(max(float(p[UP]) - ground_m, 1.0), ground_m)
        three = None if fused is None else self._odometry.three_view(fused)
        first = NodeState(registered.pose, predicted.before.calibration, predicted.motion)
        relative, links, of_links = self._linked(registered)
        new = NewNode(first, registered.parent, relative, increment, attitude, rise_m, three, motion_cov, links)
        state.keep_keyframes(state.graph.leaving)
        walk, parent = self._walk_sigmas(registered), state.graph.state(registered.parent)
        node = state.graph.extend(frame.t_s, new)
        state.motion_cov = self._motion_cov(registered)
        state.contradicted_images.propagate(increment)
        state.covariances.extended(new, parent, walk, state.motion_cov)
        self._continuity_of(predicted, node)
        state.register_frame(node, frame.frame_id, predicted.odometry.fragment)
        step, of_aids = self._fuse_aids(registered, node, dt_s)
        last = state.refresh_newest()
        if fused is not None:
            state.last_fused_s = frame.t_s
            self._doubt.on_fused(frame.t_s - dt_s)
            state.speed_prior.update(frame.t_s, last.velocity_mps, last.velocity_cov)
            for aid in self._aids:
                aid.after_frame(last, frame.attitude)
        result = _result(predicted, last, step, [*verdicts, *of_links, *of_aids])
        off = predicted.odometry.motion_innovation
        return replace(result, motion=predicted.odometry.motion, off=None if off is None else off.horizontal)

    def _linked(
        self, registered: RegisteredFrame
    ) -> tuple[RelativePose, tuple[tuple[int, MatchedRays], ...], list[FusionVerdict]]:
        """The motion since the parent; node and matched rays of each further keyframe that agrees with it; and the
        verdicts on these."""
        accepted, verdicts = list[tuple[int, MatchedRays]](), list[FusionVerdict]()
        fused, relative = registered.predicted.odometry.fused, registered.relative
        for link in [] if fused is None else self._odometry.links(fused, registered.predicted.frame):
            verdict = link if isinstance(link, FusionVerdict) else link.verdict(self._state)
            verdicts.append(verdict)
            if isinstance(link, LinkMeasurement) and verdict.verdict is Verdict.ACCEPTED:
                assert link.motion.rays is not None
                accepted.append((link.keyframe, link.motion.rays))
        if not accepted or relative.rays is None:
            return relative, (), verdicts
        count = 1 + len(accepted)
        shared = replace(relative, rays=relative.rays.sharing(count))
        return shared, tuple((keyframe, rays.sharing(count)) for keyframe, rays in accepted), verdicts

    def _motion_cov(self, registered: RegisteredFrame) -> np.ndarray:
        """Covariance (8, 8) of V of the newest node by the motion model and odometry. A motion factor that has less
        weight in the graph has it here, too."""
        state, predicted, position = self._state, registered.predicted, registered.position
        cov = predicted.cov
        if state.mode is CovarianceMode.JACOBIAN and position is not None and predicted.increment is not None:
            increment = replace(predicted.increment, cov=predicted.increment.cov / state.graph.motion_weight)
            cov = predict_covariance(increment, state.motion_cov)
            _, cov, _ = fuse_odometry_increment(increment, position.off_m, cov, position.cov_m2)
        return cov[DELTA_MOTION, DELTA_MOTION]

    def _walk_sigmas(self, registered: RegisteredFrame) -> np.ndarray:
        """1-sigma (6,) of the change of B since the parent."""
        state, parent = self._state, self._state.graph.state(registered.parent).pose
        turned = registered.pose.rotation().compose(parent.rotation().inverse())
        rise_m = state.terrain.rise_sigma_m(float(np.hypot(*(registered.p_m - parent.translation())[:2])))
        dt_s = state.graph.since_s(registered.parent, registered.predicted.frame.t_s)
        return walk_sigmas(dt_s, float(gtsam.Rot3.Logmap(turned)[UP]), rise_m)

    def _continuity_of(self, predicted: PredictedFrame, node: int) -> None:
        continuity, increment, fused = self._state.continuity, predicted.increment, predicted.odometry.fused
        continuity.last_increment_inertial = None if increment is None else increment.inertial
        if not predicted.frame.attitude.stands:
            continuity.stationary_node = None
        elif continuity.stationary_node is None:
            continuity.stationary_node = node
        measured = increment is None or increment.inertial
        continuity.inertial_since_fused = fused is not None or (continuity.inertial_since_fused and measured)
        continuity.keyframe_motion = None if fused is None else (fused.parent, fused.motion.p_m)

    # --- aids ------------------------------------------------------------------------------------------------------

    def _fuse_aids(self, registered: RegisteredFrame, node: int, dt_s: float) -> tuple[Step, list[FusionVerdict]]:
        """Measurements beside odometry, in the order of the table. -> the step with them, and their verdicts."""
        predicted, state, step, verdicts = registered.predicted, self._state, registered.step, list[FusionVerdict]()
        frame, observed = predicted.frame, predicted.odometry.fused is not None or predicted.increment is None
        sample = AidSample(node, frame.t_s, frame.attitude, frame.imu, dt_s, observed)
        for aid in self._aids:
            verdict = self._fuse_aid(aid, sample)
            if verdict is None:
                continue
            verdicts.append(verdict)
            if aid.leads_step and not observed and verdict.verdict is Verdict.ACCEPTED:
                moved = state.graph.state(node).pose.translation() - predicted.before.pose.translation()
                cov = replace_motion_covariance(predicted.cov, state.motion_cov)
                step = Step(moved[:2], worst_sigma(cov[:2, :2]))
        return step, verdicts

    def _fuse_aid(self, aid: AidSource, sample: AidSample) -> FusionVerdict | None:
        """Verdict on the measurement of ``aid`` for this frame; None: it has none there."""
        measurement = aid.measurement(sample)
        if measurement is None:
            return None
        fusion = fuse(self._state, sample.node, measurement)
        aid.on_fused(sample, fusion.verdict)
        return fusion

    # --- gates ---------------------------------------------------------------------------------------------------

    def _gate_heading(self, frame: FrameInput, odometry: GatedOdometry, before: NodeState) -> FusionVerdict | None:
        """The reported heading against the turn that odometry saw. -> the verdict on a heading that is rejected."""
        state, fused = self._state, odometry.fused
        if fused is None or frame.attitude.yaw_rad is None or frame.attitude.stands or state.yaw_gauge is not None:
            return None
        innovation = heading_innovation(state, frame.attitude, fused.parent, fused.motion.r, before)
        return self._heading_gate.rejection(innovation, state.last_fix_s)

    def _gate_height(self, registered: RegisteredFrame) -> FusionVerdict | None:
        """The reported height against the predicted one. -> the verdict on a height that is rejected."""
        predicted = registered.predicted
        attitude, climb_m2 = predicted.frame.attitude, float(predicted.cov[UP, UP])
        if attitude.agl_m is None or attitude.stands:
            return None
        innovation = height_innovation(self._state, attitude.agl_m, registered.p_m, predicted.before, climb_m2)
        return self._height_gate.rejection(innovation, self._state.last_fix_s)

    def _is_velocity_wrong(self, predicted: PredictedFrame) -> bool:
        odometry = predicted.odometry
        innovation = odometry.motion_innovation
        if odometry.fused is None or innovation is None or odometry.begins_disconnected:
            return False
        return self._doubt.is_to_one_side(innovation, self._motion_of(predicted.before))

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
        self._doubt.on_unknown()
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


def _result(
    predicted: PredictedFrame, placed: FrameState, step: Step, verdicts: list[FusionVerdict]
) -> PropagationResult:
    verdict = predicted.odometry.verdict
    return PropagationResult(verdict, placed, step.moved_m, step.sigma_m, tuple(verdicts))
