"""The estimator proper: what moves (propagation.py), and here what the map says of it.

Everything is asked in two steps: ``advance`` takes a frame's odometry and says where the camera should be, ``fix``
takes the frame's map match. Both answer with a verdict."""

import math
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.core.gate import GATE
from terrafix.core.initial_position import SEARCHED_START_M
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.factors.custom_factors import HEIGHT
from terrafix.estimator.graph.pose_graph import NodeState
from terrafix.estimator.integrity.correlated_fixes import CorrelatedFixes
from terrafix.estimator.integrity.fragments import MapHits
from terrafix.estimator.integrity.innovation_run import InnovationRun
from terrafix.estimator.integrity.map_consistency import MapConsistency
from terrafix.estimator.integrity.other_place import AGREEING, OtherPlace
from terrafix.estimator.integrity.position_hypotheses import PositionHypotheses
from terrafix.estimator.measurements.map_pose import determined, measured_pose, moved_by_lens, straightened_pose
from terrafix.estimator.measurements.telemetry_buffer import Attitude
from terrafix.estimator.models.motion_model import V_SIZE, unknown_cov
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.propagation import STEP_SHARE, ImuQuery, Propagation, PropagationResult, no_imu
from terrafix.messages import CovarianceMode, MapMatch, Odometry, Origin, Verdict

COARSE_CONTINUES = 0.5  # of the height: sigma of the estimate up to which the belief's mode alone is taken as a fix
COARSE_FINDS_AFTER, COARSE_FINDS_OVER = 6, 1.0  # ... and so many that agree, over so many heights, find a position
RECOVER_AFTER = 3  # fixes that agree with each other and not with the graph
RECOVER_OVER = 0.5  # of the height: the motion they must span, so that they are not one mistake seen thrice
RECOVER_MASS = 0.97
# Patches: of 930 wrong places one gave a pose on so many, and of 400 starts one is wrong
# (anchor/verification/lock_monitor.py).
OUTWEIGHS_START = 20
# What the anchor says of a frame that it looked at and found no pose for.
NOTHING_FOUND = (Verdict.AMBIGUOUS, Verdict.FEW_INLIERS, Verdict.DEGENERATE)
RESTART_INFLATION = 4.0  # of the covariance of the fix that starts the graph anew


@dataclass(frozen=True)
class FixResult:
    verdict: Verdict
    mahalanobis2: float | None
    detail: str = ""
    start_off: str = ""  # the map contradicts the start coordinate, which no match had borne out; empty: it does not


class Estimator(Propagation):
    def __init__(self, origin: Origin, known: NavPrior | None = None) -> None:
        super().__init__(origin, known)
        self.hypotheses = PositionHypotheses(origin)
        self.map_sigma_m = 0.0  # of the map that placed us; nothing until it did
        self._torn: dict[int, np.ndarray] = {}  # frame -> spread (2, 2) of the two places between which it was
        self._seen = CorrelatedFixes()
        self._map_hits = MapHits()
        self._heard_ns = -1  # frame of the newest map match
        self._refused = InnovationRun()  # with each other, not with the graph
        self._vague = InnovationRun()  # coarse ones, of a graph that does not know where it is

    def advance(
        self, frame_id: int, t_s: float, odometry: Odometry, attitude: Attitude, felt: ImuQuery = no_imu
    ) -> PropagationResult:
        advance = super().advance(frame_id, t_s, odometry, attitude, felt)
        if self.hypotheses.other.probability > 0.0:  # for the refinement, which cannot tell right from wrong either
            self._torn[frame_id] = self.hypotheses.other.spread_m2()
        return advance

    def fix(self, match: MapMatch) -> FixResult:
        """A map match of a frame that ``advance`` has seen. Gated; enters the graph at its own node."""
        node = self._node_of.get(match.frame_id)
        if node is not None and not self.graph.holds(node):
            node = None
        if match.found or match.t_ns >= self._heard_ns:  # of ground and belief the newest frame says most, or a search
            self._heard_ns = max(match.t_ns, self._heard_ns)
            self.terrain.hear(match, None if node is None else self.graph.state(node).pose.translation())
            lost = self.hypotheses.hear(match)
            if node is not None and match.modes:
                self._weigh(match, node)
            if lost:
                return FixResult(Verdict.LOST, None, lost)
        if node is not None and (match.coarse or match.verdict in NOTHING_FOUND):
            self._map_hits.looked(self._fragments.of(node), found=False)
        if match.verdict is not Verdict.ACCEPTED:
            return FixResult(match.verdict, None)
        if not determined(match):
            return FixResult(Verdict.DEGENERATE, None)
        if node is None:
            return FixResult(Verdict.STALE, None)
        measured, cov = measured_pose(match, self.terrain)
        seen, seen_cov = measured, cov  # the graph hears of it as it was seen
        measured, cov, by_lens = self.through_lens(match, seen, seen_cov)
        r_w_c = measured.rotation().matrix()
        height = max(float(measured.translation()[2]) - self.terrain.ground_m, 1.0)
        if match.found:  # by a search, over several frames: it outweighs whatever the graph believes
            self.hypotheses.other, self.hypotheses.map_consistency = OtherPlace(), MapConsistency()
            return self._restart(match, node, measured, cov, "found")
        if self._open is not None:
            if match.coarse:  # its heading is one of those that were tried
                return FixResult(Verdict.AMBIGUOUS, None, "a coarse fix does not tell the heading")
            away2 = self._away2(match.frame_id, node, measured, cov)
            if away2 > GATE[2]:
                return self._refuse(match, node, measured, cov, away2)
            return self._restart(match, node, measured, cov, "heading found")
        if match.coarse and not self._fragments.of(node).joined:  # it says what the belief remembers, not what is seen
            return FixResult(Verdict.UNCONFIRMED, None, "a coarse fix does not join a fragment to the flight")
        predicted = self.graph.state(node).pose
        spread = float(np.sqrt(np.max(np.diag(tangent_to_world(self._covariance(node), r_w_c))[:2])))
        if match.coarse and spread > COARSE_CONTINUES * height:
            offset = (measured.translation() - predicted.translation())[:2]
            self._vague.add(offset, predicted.translation()[:2], coarse=True)
            if not self._vague.holds(COARSE_FINDS_AFTER, COARSE_FINDS_OVER * height):
                return FixResult(Verdict.AMBIGUOUS, None, "a coarse fix continues a track, several find one")
        self._vague.clear()
        innovation = predicted.logmap(measured)
        d2 = float(innovation @ np.linalg.solve(self._covariance(node) + cov, innovation))
        if d2 > GATE[6]:
            return self._refuse(match, node, measured, cov, d2)
        self._refused.clear()
        here = measured.translation()[:2]
        if not match.coarse and self.measures_height and not self.terrain.is_told:
            up_m = self.graph.state(node).up_by_barometer_m
            sigma_m = float(np.sqrt(tangent_to_world(cov, r_w_c)[2, 2]))
            self.terrain.ruggedness.measured(here, height, float(up_m - measured.translation()[2]), sigma_m)
        fixed_s = self.graph.time_of(node)
        if not match.coarse and self._seen.newest_s is not None:
            new_heights = self._seen.new_m(fixed_s, here, math.inf) / height
            self.hypotheses.other.fade(new_heights, match.mode_mass)
        new = self._seen.share(fixed_s, here, height)
        self.graph.add_pose(node, seen, seen_cov / new, by_lens, match.lens)
        if self.mode is CovarianceMode.JACOBIAN:
            self._cov_of[node] = np.linalg.inv(np.linalg.inv(self._cov_of[node]) + np.linalg.inv(cov / new))
        if not match.coarse:
            self._map_hits.looked(self._fragments.of(node), found=True)
            self.hypotheses.map_consistency.agreed(new)
        self._accepted(match, fixed_s, here)
        return FixResult(Verdict.ACCEPTED, d2, f"new ground {new:.2f}")

    def _weigh(self, match: MapMatch, node: int) -> None:
        """The belief's modes against the estimate of the same frame."""
        placed = self._placed(match.frame_id, self.graph.time_of(node), node)
        p_m = np.asarray(placed.pose.translation())
        height_m = max(float(p_m[2]) - self.terrain.ground_m, 1.0)
        self.hypotheses.weigh(match, p_m, tangent_to_world(placed.cov, placed.pose.rotation().matrix()), height_m)

    def through_lens(
        self, match: MapMatch, seen: gtsam.Pose3, cov: np.ndarray
    ) -> tuple[gtsam.Pose3, np.ndarray, np.ndarray | None]:
        """The pose of a match and its covariance, through the lens as it is known by now, and ``moved_by_lens``."""
        by_lens = moved_by_lens(match)
        bend, sigma = self.lens_learnt
        return *straightened_pose(seen, cov, by_lens, bend - match.lens, sigma), by_lens

    def _away2(self, frame_id: int, node: int, measured: gtsam.Pose3, cov: np.ndarray) -> float:
        """Squared Mahalanobis distance (2 degrees of freedom) of a place from where the camera can be, whatever its
        heading is."""
        placed = self._placed(frame_id, self.graph.time_of(node), node)
        offset, apart = _offset(placed.pose, placed.cov, measured, cov)
        return float(offset @ np.linalg.solve(apart, offset))

    def _accepted(self, match: MapMatch, t_s: float, here: np.ndarray) -> None:
        self._seen.add(t_s, here)
        self._seen_s = max(self._seen_s, t_s)
        self.last_fix_s = self._seen.newest_s
        self.hypotheses.confirmed()
        self.map_sigma_m = match.map_sigma_m
        assert self._last is not None
        self._last = self._placed(self._last.frame_id, self._last.t_s, self.graph.newest)
        self._pace.fixed(self._last.t_s, self._last.velocity_mps, self._last.velocity_cov)

    def _refuse(self, match: MapMatch, node: int, measured: gtsam.Pose3, cov: np.ndarray, d2: float) -> FixResult:
        """Refused, unless several fixes over new ground agree with each other: then it is the graph that is lost."""
        predicted = self.graph.state(node).pose
        offset, apart = _offset(predicted, self._covariance(node), measured, cov)
        row = self._refused
        agrees = row.add(offset, predicted.translation()[:2], coarse=match.coarse)
        if not match.coarse and not agrees:  # those that agree with each other speak for another place
            self.hypotheses.map_consistency.refused(offset)
        height = float(measured.translation()[2]) - self.terrain.ground_m
        # A pose stands on patches of its own frame. A coarse one says what the belief remembers: one look that went
        # astray is in all that follow. Where nothing is in doubt they count against the graph when they would find a
        # position without it; where another place has spoken already they are more of what speaks for it.
        sure = self.hypotheses.other.probability == 0.0
        found = row.holds(COARSE_FINDS_AFTER, COARSE_FINDS_OVER * height)
        if found or (row.poses if sure else len(row.offsets_m)) >= AGREEING:
            self.hypotheses.other.disagreed(row.offsets_m, apart, fixed=self.last_fix_s is not None)
            # Before the first fix only the start coordinate speaks for the graph: as much as one such pose against it.
            first = self.last_fix_s is None and match.inliers >= OUTWEIGHS_START
            needed = (AGREEING, 0.0) if first else (RECOVER_AFTER, RECOVER_OVER * height)
            if (found or row.holds(*needed, poses=sure)) and match.mode_mass >= RECOVER_MASS:
                self.hypotheses.other.left(offset, apart)
                return self._restart(match, node, measured, cov, "restarted")
        return FixResult(Verdict.INNOVATION, d2, f"{float(np.hypot(*offset)):.0f} m from the estimate")

    def _restart(self, match: MapMatch, node: int, measured: gtsam.Pose3, cov: np.ndarray, how: str) -> FixResult:
        """The graph begins anew: where the map says that the camera was, and since a match comes late, from there by
        what the graph has of the way to the newest frame."""
        was, now = self.graph.state(node), self.graph.state(self.graph.newest)
        fixed_s, now_s = self.graph.time_of(node), self.graph.time_of(self.graph.newest)
        offset, apart = _offset(was.pose, self._covariance(node), measured, cov)
        start_off = self._start_off(offset, apart)
        onward = was.pose.between(now.pose)
        moved = onward.inverse().AdjointMap()
        cov = RESTART_INFLATION * moved @ cov @ moved.T
        velocity_sigma = float(np.sqrt(np.linalg.eigvalsh(self._velocity_cov[:3, :3])[-1]))
        way_m = float(np.linalg.norm(onward.translation()))
        cov[3:, 3:] += np.hypot(STEP_SHARE * way_m, velocity_sigma * (now_s - fixed_s)) ** 2 * np.eye(3)
        bias = now.bias.copy()
        if match.found:  # the ground there lies at another height than the one that was assumed
            bias[HEIGHT] -= float(measured.translation()[2] - was.pose.translation()[2])
        bias_cov = self.graph.bias_covariance(self.graph.newest)
        velocity = now.velocity
        self._velocity_cov = RESTART_INFLATION * self.graph.velocity_covariance(self.graph.newest)
        if self._open is not None:  # it was one along axes that nobody knew
            velocity, self._velocity_cov, self._open = np.zeros(V_SIZE), unknown_cov(), None
        self.graph.start(now_s, NodeState(measured.compose(onward), bias, velocity), cov, bias_cov, self._velocity_cov)
        assert self._last is not None
        self._cov_of.clear()
        self._graph_began(self.graph.newest, self._last.frame_id, now_s)
        self._refused.clear()
        self.hypotheses.moved(match.lost_sigma_m)
        self._seen = CorrelatedFixes()
        self._accepted(match, fixed_s, measured.translation()[:2])
        return FixResult(Verdict.ACCEPTED, None, f"{how} {float(np.hypot(*offset)):.0f} m away", start_off)

    def _start_off(self, offset: np.ndarray, apart_m2: np.ndarray) -> str:
        """``offset`` (2,): from where a flight that no match has placed was to where the first ones place it;
        ``apart_m2`` (2, 2): what both claim of it. Nothing on board tells which of the two is in the wrong place."""
        searched = self.origin.start_sigma_m > SEARCHED_START_M
        if self.last_fix_s is not None or searched or float(offset @ np.linalg.solve(apart_m2, offset)) <= GATE[2]:
            return ""
        return f"start and map are {float(np.hypot(*offset)):.0f} m apart: one of them is wrong"

    def refine(self) -> dict[int, tuple[np.ndarray, np.ndarray]]:
        """frame -> position (3,) and its covariance (3x3), by all that was measured in the flight, after landing."""
        result = {}
        levers = np.array(self._levers).reshape(-1, 2, 2)
        for frame, lever, p_m, cov in zip(self._frames, levers, *self.graph.refine(), strict=True):
            if np.isfinite(p_m).all() and np.isfinite(cov).all():
                if frame in self._torn:
                    cov[:2, :2] += self._torn[frame]
                aside_m, aside_cov = self.middle.aside(lever)
                p_m[:2] += aside_m
                cov[:2, :2] += aside_cov
                result[frame] = (p_m, cov)
        return result


def _offset(
    pose: gtsam.Pose3, pose_cov: np.ndarray, measured: gtsam.Pose3, measured_cov: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """From one pose to another, east and north (2,), and its covariance (2, 2); theirs 6x6, tangent order."""
    both = [tangent_to_world(cov, p.rotation().matrix()) for p, cov in ((pose, pose_cov), (measured, measured_cov))]
    return (measured.translation() - pose.translation())[:2], (both[0] + both[1])[:2, :2]
