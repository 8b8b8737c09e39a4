"""Replays a flight through the estimator that flew, and records all factors of its graph for the batch smoother.

The replay repeats the decisions of the flight: which keyframe a frame was measured against, over what ground, and the
motion increment of the IMU. Nodes that left the window, and map matches that were rejected, are recorded too."""

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, F, V

from terrafix.core.pnp import solved
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.factors.focal import FocalKey
from terrafix.estimator.factors.motion import motion_factor
from terrafix.estimator.graph.marginalized import THREE_VIEW_NODES
from terrafix.estimator.graph.pose_graph import GraphObserver, GraphPrior, NewNode, PoseGraph
from terrafix.estimator.measurements.map_pose import determined, measured_pose, moved_by_focal, moved_by_k1
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.models.bias_walk import WALK_SIGMAS
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.models.terrain import Terrain
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import NavPrior
from terrafix.estimator.relocalization_update import RelocalizationResult
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE, POSE_SIZE, UP, NodeState
from terrafix.messages import (
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    Relocalization,
    VehicleState,
    Verdict,
)
from terrafix_tools.finalise.map_points import MatchedPoints
from terrafix_tools.finalise.point_cloud import FeatureTracks

SAME_FRAME_M, SAME_FRAME_MPS = 0.01, 0.01  # 1-sigma (m and rad; m/s) between two nodes of one frame
# Successive map matches that are held out together, and whose errors count as one number: they lie over the same
# ground, with the same error of the map, which a track follows that was given their neighbours. [tuned]
HELD_OUT_RUN = 8
SAME_FRAME_WALK = 0.01  # share of one second's random walk of B between these


@dataclass
class RecordedNode:
    """A node of the flight. ``factors``: those to earlier nodes, without those of ``motion`` from ``parent`` if it is
    from odometry and of ``triples``, and without the priors of pose and calibration."""

    t_s: float
    state: NodeState  # last estimate in flight
    factors: list[gtsam.NonlinearFactor]
    parent: int = -1  # -1: first node of a graph
    motion: RelativePose | None = None
    keyframe_m: np.ndarray | None = None  # (3,) of the parent when its ground plane was computed
    prior: tuple[gtsam.Pose3, np.ndarray] | None = None  # first pose of a graph, with covariance (6, 6), tangent order
    calibration: tuple[np.ndarray, np.ndarray] | None = None  # ... and its B, with covariance
    triples: "Triples | None" = None
    again: bool = False  # same frame as the node before, after a map match has reset the graph


@dataclass(frozen=True)
class Triples:
    """Points that a node, its parent and the node ``first`` see: ``xy`` (N, 6) normalised by the description of the
    camera (first, parent, node), with 1-sigma ``sigma``. ``rises``, ``ground_m``: as in flight (three_view_factor)."""

    first: int
    rises: bool
    ground_m: float
    xy: np.ndarray
    sigma: float


@dataclass(frozen=True)
class Fix:
    """A map match at ``node``: camera pose with covariance (6, 6), tangent order, and the error that the map states.

    ``by_lens`` (6, 2): change of the pose by the radial coefficient, which was ``k1``, and by the logarithm of the
    focal length. ``points``: its 2D-3D matches; None: the matcher has computed the pose itself. ``tried`` False: it was
    too vague in flight to determine a position, and the smoother may use it as a confirmation only."""

    node: int
    pose: gtsam.Pose3
    cov: np.ndarray
    map_sigma_m: float
    position_only: bool
    by_lens: np.ndarray
    k1: float
    tried: bool
    points: MatchedPoints | None


@dataclass(frozen=True)
class LoopClosure:
    """An accepted relocalisation: ``motion`` of ``node`` from the older node ``parent``, whose camera was at
    ``keyframe_m`` (3,) when the ground plane of the motion was computed."""

    node: int
    parent: int
    motion: RelativePose
    keyframe_m: np.ndarray


class GraphRecorder(GraphObserver):
    """Records every node of the flight's ``graph`` with its factors."""

    def __init__(self) -> None:
        self.nodes: list[RecordedNode] = []
        self.graph = PoseGraph(observer=self)

    def before_node(self, graph: PoseGraph) -> None:
        self.store_estimates()

    def started(self, graph: PoseGraph, t_s: float, prior: GraphPrior, others: list[gtsam.NonlinearFactor]) -> None:
        node, newest = graph.next_node, self.nodes[-1] if self.nodes else None
        if newest is not None and newest.t_s == t_s:
            # A map match has reset the graph: the same frame, and its motion since the frame before stands.
            self.nodes.append(RecordedNode(t_s, prior.state, _same_frame(node - 1, node), graph.newest, again=True))
        else:
            kept = [f for f in others if list(f.keys()) != [B(node)]]
            calibration = prior.state.calibration, prior.calibration_cov
            pose = prior.state.pose, prior.cov
            self.nodes.append(RecordedNode(t_s, prior.state, kept, prior=pose, calibration=calibration))

    def extended(
        self,
        graph: PoseGraph,
        t_s: float,
        new: NewNode,
        odometry: gtsam.NonlinearFactor,
        others: list[gtsam.NonlinearFactor],
    ) -> None:
        # The smoother makes its own odometry factor of rays.
        if new.increment is not None and new.motion_cov is None:  # others[0] is that of the increment
            n, last = graph.next_node, graph.newest
            keys = (C(last), V(last)), (C(n), V(n)), (B(last), B(n))
            others = [motion_factor(*keys, new.increment, new.state.pose.rotation(), FocalKey(F(0), 0.0)), *others[1:]]
        triples = None
        if new.three_view is not None:
            first, constraint = new.three_view
            kept = [factor for factor in others if not _is_three_view(factor)]
            if len(kept) < len(others):  # the first keyframe may have left the window
                ground_m, rises = constraint.at.ground_m, new.rise_sigma_m > 0.0
                triples, others = Triples(first, rises, ground_m, np.zeros((0, 6)), 0.0), kept
        factors = others if new.motion.rays is not None else [odometry, *others]
        keyframe_m = np.asarray(graph.state(new.parent).pose.translation())
        self.nodes.append(RecordedNode(t_s, new.state, factors, new.parent, new.motion, keyframe_m, triples=triples))

    def add_triples(self, odometry: Odometry) -> None:
        """The points of the newest node, whose frame was ``odometry``'s."""
        node = self.nodes[-1]
        if node.triples is not None:
            xy, sigma = np.array(odometry.three_view), odometry.three_view_sigma_norm
            node.triples = replace(node.triples, xy=xy, sigma=sigma)

    def store_estimates(self) -> None:
        """Records the estimates of the nodes in the window."""
        for node in self.graph.window:
            self.nodes[node].state = self.graph.state(node)


def _is_three_view(factor: gtsam.NonlinearFactor) -> bool:
    keys: list[int] = list(factor.keys())
    return sum(gtsam.symbolChr(key) == gtsam.symbolChr(C(0)) for key in keys) == THREE_VIEW_NODES


def _same_frame(first: int, second: int) -> list[gtsam.NonlinearFactor]:
    """Factors between two nodes of one frame."""
    same = gtsam.noiseModel.Isotropic.Sigma
    walk = gtsam.noiseModel.Diagonal.Sigmas(SAME_FRAME_WALK * WALK_SIGMAS)
    return [
        gtsam.BetweenFactorPose3(C(first), C(second), gtsam.Pose3(), same(6, SAME_FRAME_M)),
        gtsam.BetweenFactorVector(B(first), B(second), np.zeros(CALIBRATION_SIZE), walk),
        gtsam.BetweenFactorVector(V(first), V(second), np.zeros(MOTION_SIZE), same(MOTION_SIZE, SAME_FRAME_MPS)),
    ]


@dataclass
class FlightGraph:
    """One flight: its recorded graph, its map matches, and the node of every frame that has one."""

    origin: Origin
    recorder: GraphRecorder = field(default_factory=GraphRecorder)
    fixes: list[Fix] = field(default_factory=list)
    held_out: list[Fix] = field(default_factory=list)  # map matches that the estimator was not given
    loops: list[LoopClosure] = field(default_factory=list)
    node_of: dict[int, int] = field(default_factory=dict)
    fragment_of: dict[int, int] = field(default_factory=dict)  # of each frame
    refused: dict[str, int] = field(default_factory=dict)  # number of map matches that are not used, by verdict
    lost_sigma_m: dict[int, float] = field(default_factory=dict)  # node -> 1-sigma of a position that may be wrong
    radial_k1: tuple[float, float] = 0.0, 0.0  # final radial coefficient, and its 1-sigma
    principal_point: PrincipalPointFilter | None = None
    has_height: bool = False  # the autopilot reported one
    features: FeatureTracks = field(default_factory=FeatureTracks)


class RecordedEstimator(Estimator):
    """The estimator of ``flight``, which records its loop closures."""

    def __init__(self, origin: Origin, prior: NavPrior | None, flight: FlightGraph) -> None:
        super().__init__(origin, prior, flight.recorder.graph)
        self._flight = flight

    def feed_relocalization(self, seen: Relocalization) -> RelocalizationResult:
        result = super().feed_relocalization(seen)
        nodes = self._flight.node_of
        if result.measurement is not None and {seen.frame_id, seen.keyframe_id} <= nodes.keys():
            motion = result.measurement.motion
            keyframe_m = np.asarray(result.measurement.pose.compose(motion.between.inverse()).translation())
            self._flight.loops.append(LoopClosure(nodes[seen.frame_id], nodes[seen.keyframe_id], motion, keyframe_m))
        return result


class FlightReplayer(EstimatorNode):
    """The node that flew, which keeps what it is fed. ``flights``: one for each Origin, and each
    InitialPosition, from which its estimator began; ``estimators``: those of them. ``hold_out_every``: of the runs of
    HELD_OUT_RUN map matches with a pose, one in so many is held out; 0: none."""

    def __init__(self, hold_out_every: int = 0) -> None:
        self.flights: list[FlightGraph] = []
        self.estimators: list[Estimator] = []
        super().__init__(make_estimator=self._recorded_estimator)
        self._hold_out_every, self._with_pose = hold_out_every, 0

    def _recorded_estimator(self, origin: Origin, prior: NavPrior | None) -> Estimator:
        self.flights.append(FlightGraph(origin))
        self.estimators.append(RecordedEstimator(origin, prior, self.flights[-1]))
        return self.estimators[-1]

    def on(self, message: Message) -> Iterable[Message]:
        if isinstance(message, MapMatch) and self._holds_out(message):
            return []
        published = list(super().on(message))
        estimator = self.estimator
        if estimator is None:
            return published
        flight = self.flights[-1]
        if isinstance(message, VehicleState):
            flight.has_height = flight.has_height or message.agl_m is not None
        elif isinstance(message, Odometry) and any(isinstance(s, NavEstimate) for s in published):
            flight.node_of[message.frame_id] = flight.recorder.graph.newest
            flight.fragment_of[message.frame_id] = message.fragment_id
            flight.recorder.add_triples(message)
            flight.features.add(message)
            flight.radial_k1 = estimator.state.radial_k1_estimate
            flight.principal_point = estimator.state.principal_point
        elif isinstance(message, MapMatch):
            verdict = next((s.verdict for s in published if isinstance(s, MeasurementVerdict)), Verdict.STALE)
            self._add_match(message, verdict, estimator)
        return published

    def _holds_out(self, match: MapMatch) -> bool:
        """Counts the matches with a pose, and holds out one run in ``hold_out_every``, where its frames have nodes."""
        estimator = self.estimator
        if not self._hold_out_every or estimator is None or match.verdict is not Verdict.ACCEPTED:
            return False
        run, self._with_pose = self._with_pose // HELD_OUT_RUN, self._with_pose + 1
        fix = self._fix(match, estimator) if (run + 1) % self._hold_out_every == 0 else None
        if isinstance(fix, Fix):
            self.flights[-1].held_out.append(fix)
        return isinstance(fix, Fix)

    def _add_match(self, received: MapMatch, verdict: Verdict, estimator: Estimator) -> None:
        flight, fix = self.flights[-1], self._fix(received, estimator)
        if (node := flight.node_of.get(received.frame_id)) is not None:
            flight.lost_sigma_m[node] = estimator.doubts.sigma_m
        if isinstance(fix, Verdict):
            flight.refused[str(fix)] = flight.refused.get(str(fix), 0) + 1
        else:
            flight.fixes.append(replace(fix, tried=verdict is not Verdict.AMBIGUOUS))

    def _fix(self, received: MapMatch, estimator: Estimator) -> Fix | Verdict:
        """The pose of a map match; or why there is none."""
        node, match = self.flights[-1].node_of.get(received.frame_id), solved(received)
        if match.verdict is not Verdict.ACCEPTED:
            return match.verdict
        if node is None or match.pose is None or not determined(match):
            return Verdict.STALE
        pose, cov = measured_pose(match.pose, match.map_sigma_m, estimator.terrain)
        return Fix(
            node,
            pose,
            cov,
            match.map_sigma_m,
            match.position_only,
            moved_by_lens(match, estimator.terrain),
            match.radial_k1,
            True,
            MatchedPoints.of(received, match, estimator.terrain),
        )


def moved_by_lens(match: MapMatch, terrain: Terrain) -> np.ndarray:
    """(6, 2) tangent order: change of the pose of a match that is ``determined`` by one unit of the radial coefficient,
    and of the logarithm of the focal length. Without points the camera moves away from the ground along its axis."""
    by_k1, by_focal = moved_by_k1(match), moved_by_focal(match)
    if by_k1 is not None and by_focal is not None:
        return np.column_stack([by_k1, by_focal])
    assert match.pose is not None
    moved = np.zeros((POSE_SIZE, 2))
    moved[-1, 1] = -max(match.pose.p_c_in_w_m[UP] - terrain.ground_m, 1.0)
    return moved
