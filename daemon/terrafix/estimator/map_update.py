"""Map matches: gated, fused, and compared with other positions that the vehicle may have."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from terrafix.core.initial_position import SEARCH_START_SIGMA_M
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.filter_state import FilterState, PastFrame
from terrafix.estimator.graph.pose_graph import GraphPrior
from terrafix.estimator.initialization import ResetReason, reset
from terrafix.estimator.integrity.alternative_position import MIN_CONSISTENT
from terrafix.estimator.integrity.contradicted_images import MatchedFrame
from terrafix.estimator.integrity.correlated_fixes import CorrelatedFixes
from terrafix.estimator.integrity.fragments import STEP_SHARE, MapHitRate
from terrafix.estimator.integrity.innovation import FusionVerdict, Innovation
from terrafix.estimator.integrity.innovation_run import InnovationRun
from terrafix.estimator.integrity.position_hypotheses import PositionHypotheses
from terrafix.estimator.integrity.velocity_doubt import MOTION_TIMEOUT_S
from terrafix.estimator.measurements.contract import fuse
from terrafix.estimator.measurements.map_pose import (
    FixedPose,
    MapPoseMeasurement,
    determined,
    levelled,
    levelled_innovation,
)
from terrafix.estimator.models.motion_model import unknown_motion_cov
from terrafix.estimator.monitors.image_orientation import OrientationMonitor
from terrafix.estimator.state import HEIGHT, HORIZONTAL, MOTION_SIZE, TRANSLATION, UP, VELOCITY, NodeState
from terrafix.messages import MapMatch, Verdict

# Of the height: 1-sigma of the estimate up to which a coarse match, the mode of the belief alone, is fused.
COARSE_CONTINUES = 0.5  # [tuned]
COARSE_FINDS_AFTER, COARSE_FINDS_OVER = (
    6,
    1.0,
)  # consistent coarse matches, over so many heights, that are fused [tuned]
RECOVER_AFTER = 3  # map matches that are consistent with each other and rejected by the gate [tuned]
RECOVER_OVER = 0.5  # of the height: the motion that they must span, so that they are not one repeated error [tuned]
RECOVER_MASS = 0.97  # of the belief's mode [tuned]
# Inliers: of 930 wrong places one gave a pose on so many, and of 400 starts one is wrong.
OUTWEIGHS_START = 20  # [measured: anchor/verification/lock_monitor.py]
RESTART_INFLATION = 4.0  # of the covariance of the map match at which the graph begins anew [tuned]
# Verdicts of a frame that was matched without a pose.
NOTHING_FOUND = (Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.DEGENERATE)


@dataclass(frozen=True)
class MapResult:
    """What was done with a map match: ``fusion``, the verdict on it, and ``others``: on a start coordinate that the map
    contradicts, and on a reset of the graph. ``fixed``: of an accepted match, for the smoother. ``off``: (2,) of a pose
    from the estimate of its frame, of one that the gate has rejected or that is fused. ``images_agree``: images that
    had contradicted inertial readings agree with the way to this match."""

    fusion: FusionVerdict
    others: tuple[FusionVerdict, ...] = ()
    fixed: FixedPose | None = None
    off: Innovation | None = None
    images_agree: bool = False

    @property
    def verdict(self) -> Verdict:
        return self.fusion.verdict

    @property
    def verdicts(self) -> tuple[FusionVerdict, ...]:
        return (self.fusion, *self.others)


class MapUpdate:
    """``apply`` every map match, in the order in which they come.

    ``map_sigma_m``: error of the map of the newest accepted match; 0: there was none."""

    def __init__(self, state: FilterState) -> None:
        self._state = state
        self.hypotheses = PositionHypotheses(state.origin)
        self.map_sigma_m = 0.0
        self._fixes = CorrelatedFixes()
        self._map_hit_rate = MapHitRate()
        self._newest_match_ns = -1
        self._rejected = InnovationRun()
        self._coarse = InnovationRun()  # coarse matches of a graph that does not know its position

    def apply(self, match: MapMatch) -> MapResult:
        """``match``: of a frame that ``Propagation.advance`` has had. It enters the graph at the node of that frame."""
        state = self._state
        node = state.node_of.get(match.frame_id)
        if node is not None and not state.graph.holds(node):
            node = None
        # Ground and belief: of the newest frame, or of a search.
        if match.search.relocalized or match.t_ns >= self._newest_match_ns:
            self._newest_match_ns = max(match.t_ns, self._newest_match_ns)
            if lost := self._update_belief(match, node):
                return _result(Verdict.LOST, lost)
        if node is not None and (match.position_only or match.verdict in NOTHING_FOUND):
            p_m = state.graph.state(node).pose.translation()
            height_m = max(state.terrain.height_above_m(p_m), 1.0)
            self.hypotheses.other_ground.on_nothing(p_m[HORIZONTAL], height_m, self._map_hit_rate.p_nothing)
            self._map_hit_rate.update(state.fragments.of(node), found=False)
        if match.verdict is not Verdict.ACCEPTED:
            return _result(match.verdict, f"{match.inliers} inliers" if match.verdict in NOTHING_FOUND else "")
        if node is None:
            return self._apply_late(match) or _result(Verdict.STALE, "frame has left the window")
        if not determined(match):
            return _result(Verdict.DEGENERATE, "2D-3D matches do not determine the pose")
        measurement = MapPoseMeasurement.of(match, state.terrain, state.radial_k1_estimate)
        if match.search.relocalized:  # by a search over several frames: it outweighs whatever the graph has
            self.hypotheses.on_relocalized()
            return self._reset(match, self._past(node), measurement, "found")
        if state.yaw_gauge is not None:
            return self._apply_without_heading(match, node, measurement)
        finds = match.position_only and self._is_uncertain(node, measurement)
        if match.position_only and (refusal := self._coarse_refusal(node, measurement, finds=finds)):
            return refusal
        self._coarse.clear()
        result = self._fuse(match, node, measurement)
        return self._restarted(result) if finds and result.fixed is not None else result

    def forget_rejected(self) -> None:
        """Rejected matches support no other position any more."""
        self._rejected.clear()
        self._state.image_jump = None
        self.hypotheses.on_relocalized()

    def _update_belief(self, match: MapMatch, node: int | None) -> str:
        """Ground and belief of the newest frame. -> detail of the verdict on a match that is LOST; else empty."""
        state = self._state
        state.terrain.update(match.ground, None if node is None else state.graph.state(node).pose.translation())
        lost = self.hypotheses.on_match(match.verdict, match.search)
        if node is not None and match.belief is not None:
            state.covariances.record(node)
            frame = state.frame_state(node)
            p_m = np.asarray(frame.pose.translation())
            height_m = max(float(p_m[UP]) - state.terrain.ground_m, 1.0)
            cov = tangent_to_world(frame.cov, frame.pose.rotation().matrix())
            self.hypotheses.update_modes(match.belief, p_m, cov, height_m)
        return lost

    def _apply_without_heading(self, match: MapMatch, node: int, measurement: MapPoseMeasurement) -> MapResult:
        """The first pose that agrees with the position gives the heading."""
        if match.position_only:  # its heading is one of those that were tried
            return _result(Verdict.AMBIGUOUS, "coarse match gives no heading")
        frame = self._state.frame_state(node)
        innovation = measurement.position_innovation(frame.pose, frame.cov)
        if not innovation.is_accepted:
            return self._reject(match, node, measurement, innovation)
        return self._reset(match, self._past(node), measurement, "heading found")

    def _is_uncertain(self, node: int, measurement: MapPoseMeasurement) -> bool:
        """Whether the estimate is too uncertain for a coarse match to continue it."""
        cov = tangent_to_world(self._state.covariance(node), measurement.pose.rotation().matrix())
        return float(np.sqrt(np.max(np.diag(cov)[HORIZONTAL]))) > COARSE_CONTINUES * self._height_m(measurement)

    def _coarse_refusal(self, node: int, measurement: MapPoseMeasurement, *, finds: bool) -> MapResult | None:
        """Why a coarse match is not fused; None: it is. ``finds``: the estimate is too uncertain to be continued."""
        if not self._state.fragments.of(node).confirmed:  # its position comes from earlier frames
            return _result(Verdict.UNCONFIRMED, "coarse match cannot confirm an odometry fragment")
        predicted_m = self._state.graph.state(node).pose.translation()[HORIZONTAL]
        if finds:
            self._coarse.re_estimate(self._position_of)
            self._coarse.add(measurement.position_m - predicted_m, predicted_m, position_only=True, node=node)
            if not self._coarse.is_confirmed(COARSE_FINDS_AFTER, COARSE_FINDS_OVER * self._height_m(measurement)):
                return _result(
                    Verdict.AMBIGUOUS, "coarse match: the estimate is too uncertain, six consistent ones are needed"
                )
        return None

    def _position_of(self, node: int) -> np.ndarray | None:
        """(2,) east and north of a node; None: it has left the window."""
        graph = self._state.graph
        return np.asarray(graph.state(node).pose.translation()[HORIZONTAL]) if graph.holds(node) else None

    def _fuse(self, match: MapMatch, node: int, measurement: MapPoseMeasurement) -> MapResult:
        state, height_m, here = self._state, self._height_m(measurement), measurement.position_m
        fixed_s, before = state.graph.time_of(node), state.graph.state(node)
        share = self._fixes.information_share(fixed_s, here, height_m)
        measurement = replace(measurement, information_share=share)
        predicted = before.pose, state.covariance(node)
        fixed, position = levelled(measurement, *predicted), levelled_innovation(measurement, *predicted)
        fusion = fuse(state, node, measurement)
        if fusion.verdict is not Verdict.ACCEPTED:
            assert fusion.innovation is not None
            return self._reject(match, node, measurement, fusion.innovation)
        self._rejected.clear()
        off = None if match.position_only else measurement.position_innovation(*predicted)
        contradicted = state.contradicted_images.active
        if not match.position_only:
            if match.belief is not None and not match.on_drawn:
                self.hypotheses.other_ground.on_score(share, match.belief.mode_score)
            self.hypotheses.other_ground.on_pose(share, position, height_m)
            self._learn_roughness(before, measurement)
            alone = replace(measurement, information_share=1.0)
            self._weigh_fragment(node, levelled(alone, *predicted))
        self._accept(match, fixed_s, here)
        self.hypotheses.other.on_match(match.frame_id, match.alternative_nats)
        state.covariances.record(node)
        agree = contradicted and not state.contradicted_images.active
        return MapResult(replace(fusion, detail=f"information share {share:.2f}"), (), fixed, off, agree)

    def _learn_roughness(self, before: NodeState, measurement: MapPoseMeasurement) -> None:
        """Updates terrain roughness with an accepted pose. ``before``: the node without it."""
        state, height_m, here = self._state, self._height_m(measurement), measurement.position_m
        if state.has_height and not state.terrain.has_dem:
            cov = tangent_to_world(measurement.cov, measurement.pose.rotation().matrix())
            level_m = float(before.barometric_up_m - measurement.pose.translation()[UP])
            state.terrain.roughness.update(here, height_m, level_m, float(np.sqrt(cov[UP, UP])))

    def _weigh_fragment(self, node: int, placed: FixedPose) -> None:
        """A pose joins the fragment of its frame, unless its images have contradicted inertial readings: then the next
        one decides."""
        state = self._state
        fragment = state.fragments.of(node)
        if state.contradicted_images.active:
            cov_m2 = tangent_to_world(placed.cov, placed.pose.rotation().matrix())[HORIZONTAL, HORIZONTAL]
            t_s, displacement_m = state.graph.time_of(node), state.fragments.displacement_m(node)
            matched = MatchedFrame(t_s, fragment, displacement_m, placed.pose.translation()[HORIZONTAL], cov_m2)
            state.contradicted_images.on_map_match(matched)
        else:
            fragment.join()
        self._map_hit_rate.update(fragment, found=True)

    def _accept(self, match: MapMatch, t_s: float, here_m: np.ndarray) -> None:
        state = self._state
        self._fixes.add(t_s, here_m)
        state.image_jump = None
        if not match.position_only:  # its tilt and heading are those of upright images
            state.orientation = OrientationMonitor()
        state.last_fused_s = max(state.last_fused_s, t_s)
        state.last_fix_s = self._fixes.newest_s
        state.on_placed()
        self.hypotheses.on_match_accepted()
        self.map_sigma_m = match.map_sigma_m
        last = state.refresh_newest()
        state.speed_prior.update_by_map(last.t_s, last.velocity_mps, last.velocity_cov)

    def _reject(self, match: MapMatch, node: int, measurement: MapPoseMeasurement, innovation: Innovation) -> MapResult:
        """Rejected by the gate, unless several matches over new ground agree with each other: then the graph is
        wrong."""
        state = self._state
        predicted = state.graph.state(node).pose
        predicted_cov, t_s = state.covariance(node), state.graph.time_of(node)
        position = measurement.position_innovation(predicted, predicted_cov)
        offset = position.residual
        run, other = self._rejected, self.hypotheses.other
        claim_m2 = tangent_to_world(predicted_cov, predicted.rotation().matrix())[HORIZONTAL, HORIZONTAL]
        here_m, coarse = predicted.translation()[:2], match.position_only
        jump = state.image_jump
        if not run.offsets_m and jump is not None and 0.0 <= t_s - jump[0] < MOTION_TIMEOUT_S:  # the images say so too
            run.add(jump[1].residual, here_m, position_only=coarse, t_s=jump[0], cov_m2=claim_m2)
        agrees = run.add(offset, here_m, position_only=coarse, t_s=t_s, cov_m2=claim_m2)
        if not match.position_only and not agrees:  # those that agree with each other support another position
            self.hypotheses.other_ground.on_rejected(offset)
        height = float(measurement.pose.translation()[UP]) - state.terrain.ground_m
        # A pose uses patches of its own frame only. A coarse match depends on earlier frames: one wrong correlation
        # affects all later ones. While no other position is supported, coarse matches count against the graph when they
        # would find a position without it; later they support that position.
        certain = other.weight == 0.0
        found = run.is_confirmed(COARSE_FINDS_AFTER, COARSE_FINDS_OVER * height)
        if found or (run.poses if certain else len(run.offsets_m)) >= MIN_CONSISTENT:
            assert state.last is not None
            first_frame = state.last.frame_id + 1
            apart = levelled_innovation(measurement, predicted, predicted_cov)
            if not apart.is_accepted:  # by a pose that is off in heading or height alone there is no other position
                other.spawn(run.offsets_m, apart.covariance, first_frame)
            # Before the first fix only the start coordinate supports the graph: as much as one such pose against it.
            first = state.last_fix_s is None and match.inliers >= OUTWEIGHS_START
            needed = (MIN_CONSISTENT, 0.0) if first else (RECOVER_AFTER, RECOVER_OVER * height)
            if (found or run.is_confirmed(*needed, poses_only=certain)) and _place_mass(match) >= RECOVER_MASS:
                other.switch(offset, apart.covariance, first_frame)
                return self._reset(match, self._past(node), measurement, "restarted")
        detail = f"horizontally {float(np.hypot(*offset)):.0f} m from the estimate"
        off = None if coarse else position
        return MapResult(FusionVerdict(measurement.name, Verdict.INNOVATION, innovation, detail), off=off)

    def _past(self, node: int) -> PastFrame:
        graph = self._state.graph
        return PastFrame(graph.time_of(node), graph.state(node).pose, self._state.covariance(node))

    def _apply_late(self, match: MapMatch) -> MapResult | None:
        """On a busy computer every match may come after its frame has left the window. One that agrees with the frame
        as it was then is used where it places the newest frame better than the estimate does. None: it does not."""
        state, was = self._state, self._state.left.get(match.frame_id)
        if was is None or match.position_only or not determined(match) or state.yaw_gauge is not None:
            return None
        if not state.graph.window:  # the flight is over
            return None
        measurement = MapPoseMeasurement.of(match, state.terrain, state.radial_k1_estimate)
        now = self._past(state.graph.newest)
        moved_m2, now_m2 = (
            np.linalg.eigvalsh(tangent_to_world(cov, now.pose.rotation().matrix())[HORIZONTAL, HORIZONTAL])[-1]
            for cov in (self._moved_cov(measurement.cov, was.pose.between(now.pose), now.t_s - was.t_s), now.cov)
        )
        if moved_m2 > now_m2 or not measurement.position_innovation(was.pose, was.cov).is_accepted:
            return None
        return replace(self._reset(match, was, measurement, "late"), fixed=None)  # the smoother has forgotten the frame

    def _reset(self, match: MapMatch, was: PastFrame, measurement: MapPoseMeasurement, how: str) -> MapResult:
        """A new graph at the map match of the frame ``was``, and since a match comes late, moved on to the newest frame
        by what the graph has of the motion since."""
        state = self._state
        now = state.graph.state(state.graph.newest)
        fixed_s, now_s = was.t_s, state.graph.time_of(state.graph.newest)
        position = measurement.position_innovation(was.pose, was.cov)
        fixed = levelled(measurement, was.pose, was.cov)
        offset = position.residual
        start_off = self._start_off(position)
        onward = was.pose.between(now.pose)
        cov = self._moved_cov(measurement.cov, onward, now_s - fixed_s)
        bias = now.calibration.copy()
        if match.search.relocalized:  # the ground there lies at another height than the one that was assumed
            bias[HEIGHT] -= float(measurement.pose.translation()[UP] - was.pose.translation()[UP])
        calibration_cov = state.covariances.calibration(state.graph.newest)
        velocity, motion_cov = now.motion, RESTART_INFLATION * state.covariances.motion(state.graph.newest)
        motion_cov[HORIZONTAL, HORIZONTAL] += np.outer(self._rejected.drift_mps, self._rejected.drift_mps)
        if state.yaw_gauge is not None:  # it was a velocity in gauge-fixed axes
            velocity, motion_cov, state.yaw_gauge = np.zeros(MOTION_SIZE), unknown_motion_cov(), None
        assert state.last is not None
        first = NodeState(measurement.pose.compose(onward), bias, velocity)
        tied = not state.contradicted_images.active
        prior = GraphPrior(first, cov, calibration_cov, motion_cov)
        reset(state, state.last.frame_id, now_s, prior, joined=tied, confirmed=tied)
        if not position.is_accepted:  # what led to the wrong estimate is in the kept keyframes, too
            state.keyframes.clear()
        self._rejected.clear()
        self.hypotheses.on_reset(match.search.sigma_m)
        self._fixes = CorrelatedFixes()
        self._accept(match, fixed_s, measurement.position_m)
        detail = f"{how} {float(np.hypot(*offset)):.0f} m away"
        others = [FusionVerdict("start", Verdict.INNOVATION, position, start_off)] if start_off else []
        others.append(FusionVerdict("reset", Verdict.ACCEPTED, None, f"{ResetReason.MAP_MATCH}: {how}"))
        accepted = FusionVerdict(measurement.name, Verdict.ACCEPTED, None, detail)
        return MapResult(accepted, tuple(others), fixed)

    def _restarted(self, result: MapResult) -> MapResult:
        """A new graph at the present estimate, which ``result`` has moved far. What had left the window is linear
        around the estimate of then, and would contradict what follows from the new one: heights went off by a sixth."""
        state, newest = self._state, self._state.graph.newest
        assert state.last is not None
        covs = state.covariance(newest), state.covariances.calibration(newest), state.covariances.motion(newest)
        cov, calibration_cov, motion_cov = (RESTART_INFLATION * one for one in covs)
        prior = GraphPrior(state.graph.state(newest), cov, calibration_cov, motion_cov)
        reset(state, state.last.frame_id, state.graph.time_of(newest), prior)
        state.refresh_newest()
        verdict = FusionVerdict("reset", Verdict.ACCEPTED, None, f"{ResetReason.MAP_MATCH}: found by coarse matches")
        return replace(result, others=(*result.others, verdict))

    def _moved_cov(self, cov: np.ndarray, onward: gtsam.Pose3, dt_s: float) -> np.ndarray:
        """``cov`` (6, 6), tangent order, of a pose, inflated, at the end of the motion ``onward`` of ``dt_s``."""
        moved = onward.inverse().AdjointMap()
        cov = RESTART_INFLATION * moved @ cov @ moved.T
        velocity_sigma = float(np.sqrt(np.linalg.eigvalsh(self._state.motion_cov[VELOCITY, VELOCITY])[-1]))
        way_m = float(np.linalg.norm(onward.translation()))
        cov[TRANSLATION, TRANSLATION] += np.hypot(STEP_SHARE * way_m, velocity_sigma * dt_s) ** 2 * np.eye(3)
        return cov

    def _start_off(self, position: Innovation) -> str:
        """Detail of the verdict on the start coordinate; empty: there is none. ``position``: innovation of the first
        matches in a flight that none has placed. Start and map disagree, and no on-board measurement can decide between
        them."""
        searched = self._state.origin.start_sigma_m > SEARCH_START_SIGMA_M
        if self._state.last_fix_s is not None or searched or position.is_accepted:
            return ""
        return f"start and map are {float(np.hypot(*position.residual)):.0f} m apart: one of them is wrong"

    def _height_m(self, measurement: MapPoseMeasurement) -> float:
        """Above the ground, 1 m at least."""
        return max(float(measurement.pose.translation()[UP]) - self._state.terrain.ground_m, 1.0)


def _place_mass(match: MapMatch) -> float:
    return 0.0 if match.place is None else match.place.mass


def _result(verdict: Verdict, detail: str = "") -> MapResult:
    return MapResult(FusionVerdict("map", verdict, None, detail))
