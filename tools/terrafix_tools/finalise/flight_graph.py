"""A flight told once more to the estimator that flew, and all that its graph was given, kept for the smoothing.

The estimator decides as it did in flight which keyframe a frame was measured against, over what ground, and what the
autopilot felt. What it forgot after twenty frames is remembered here, and so is a map match that it refused."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.estimator import Estimator
from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.factors.three_view import ThreeViewConstraint
from terrafix.estimator.graph.pose_graph import WALK_SIGMAS, NodeState, PoseGraph
from terrafix.estimator.measurements.map_pose import determined, measured_pose, moved_by_lens
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.models.motion_model import V_SIZE, MotionIncrement
from terrafix.estimator.models.plane_motion import RelativePose
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import NavPrior
from terrafix.messages import (
    MapMatch,
    MeasurementVerdict,
    Message,
    NavEstimate,
    Odometry,
    Origin,
    VehicleState,
    Verdict,
)

SAME_M, SAME_MPS = 0.01, 0.01  # 1-sigma (m and rad; m/s) between two nodes that are one frame
SPLIT = 0.01  # share of a second of drift of the slow errors between these


@dataclass
class RecordedNode:
    """A node of the flight: ``factors`` that tie it to earlier ones, but for what ``motion`` saw against ``parent``."""

    t_s: float
    state: NodeState  # as it was last known in flight
    factors: list[gtsam.NonlinearFactor]
    parent: int = -1  # -1: it begins
    motion: RelativePose | None = None
    keyframe_m: np.ndarray | None = None  # (3,) where the parent was when the height of the ground below it was said
    prior: tuple[gtsam.Pose3, np.ndarray] | None = None  # where it begins, with covariance (6, 6), tangent order
    again: bool = False  # the frame of the node before, which a map match has moved


@dataclass(frozen=True)
class Fix:
    """A map match at ``node``: camera pose with covariance (6, 6), tangent order, as it was seen, and the error that
    the map states."""

    node: int
    pose: gtsam.Pose3
    cov: np.ndarray
    map_sigma_m: float
    coarse: bool
    by_lens: np.ndarray | None  # what a lens of one more of bend would have moved it by (map_offsets.py) ...
    lens: float  # ... than the one that it was seen through
    tried: bool  # False: in flight it was too vague to find a place, and here it may only confirm one


class GraphRecorder(PoseGraph):
    """The graph that flies, and a memory of what it was given."""

    def __init__(self) -> None:
        super().__init__()
        self.nodes: list[RecordedNode] = []
        self._noted = RecordedNode(0.0, NodeState(gtsam.Pose3(), np.zeros(BIAS_SIZE), np.zeros(V_SIZE)), [])

    def start(
        self,
        t_s: float,
        state: NodeState,
        cov: np.ndarray,
        bias_cov: np.ndarray,
        velocity_cov: np.ndarray,
        attitude: gtsam.CustomFactor | None = None,
        held: np.ndarray | None = None,
    ) -> int:
        self.remember()
        self._noted = RecordedNode(t_s, state, [])
        newest = self.nodes[-1] if self.nodes else None
        again = newest is not None and newest.t_s == t_s
        if again:  # a map match moved the graph: it is the same frame, and the way to it is as good as before
            self._noted.parent, self._noted.again = self.newest, True
        else:
            self._noted.prior = state.pose, cov
        node = super().start(t_s, state, cov, bias_cov, velocity_cov, attitude, held)
        if again:
            self.nodes[node].factors = _same_frame(node - 1, node)
        else:
            self.nodes[node].factors = self.nodes[node].factors[1:]  # the prior of the pose stands apart
        return node

    def extend(
        self,
        t_s: float,
        state: NodeState,
        parent: int,
        motion: RelativePose,
        leg: MotionIncrement | None,
        attitude: gtsam.CustomFactor | None,
        rise_sigma_m: float = 0.0,
        three: tuple[int, ThreeViewConstraint] | None = None,
    ) -> int:
        self.remember()
        keyframe_m = np.asarray(self.state(parent).pose.translation())
        self._noted = RecordedNode(t_s, state, [], parent, motion, keyframe_m)
        node = super().extend(t_s, state, parent, motion, leg, attitude, rise_sigma_m, three)
        if motion.seen is not None:
            self.nodes[node].factors = self.nodes[node].factors[1:]  # what was seen is made a factor again, better
        return node

    def remember(self) -> None:
        """What is known of the nodes in the window."""
        for node in self._times:
            self.nodes[node].state = self.state(node)

    def _insert(self, t_s: float, state: NodeState, factors: gtsam.NonlinearFactorGraph) -> None:
        self._noted.factors = [factors.at(i) for i in range(factors.size())]
        self.nodes.append(self._noted)
        super()._insert(t_s, state, factors)


def _same_frame(first: int, second: int) -> list[gtsam.NonlinearFactor]:
    same = gtsam.noiseModel.Isotropic.Sigma
    slow = gtsam.noiseModel.Diagonal.Sigmas(SPLIT * WALK_SIGMAS)
    return [
        gtsam.BetweenFactorPose3(C(first), C(second), gtsam.Pose3(), same(6, SAME_M)),
        gtsam.BetweenFactorVector(B(first), B(second), np.zeros(BIAS_SIZE), slow),
        gtsam.BetweenFactorVector(V(first), V(second), np.zeros(V_SIZE), same(V_SIZE, SAME_MPS)),
    ]


@dataclass
class FlightGraph:
    """One flight: what its graph was given, map matches, and the node of every frame that has one."""

    origin: Origin
    graph: GraphRecorder = field(default_factory=GraphRecorder)
    fixes: list[Fix] = field(default_factory=list)
    node_of: dict[int, int] = field(default_factory=dict)
    refused: dict[str, int] = field(default_factory=dict)  # map matches that are none, by verdict
    doubt_m: dict[int, float] = field(default_factory=dict)  # node -> 1-sigma that its place may have been wrong
    lens: tuple[float, float] = 0.0, 0.0  # what was learnt of it in the end, and the 1-sigma of that
    middle: PrincipalPointFilter | None = None  # ... and of the middle of its picture
    has_height: bool = False  # the autopilot said one


class FlightReplayer(EstimatorNode):
    """Hears a record, message after message, as the estimator did. ``flights``: one for each Origin, and each Start,
    from which it began."""

    def __init__(self) -> None:
        super().__init__()
        self.flights: list[FlightGraph] = []

    def _begin(self, origin: Origin, known: NavPrior | None) -> Estimator:
        estimator = super()._begin(origin, known)
        self.flights.append(FlightGraph(origin))
        estimator.graph = self.flights[-1].graph
        return estimator

    def on(self, message: Message) -> Iterable[Message]:
        said = list(super().on(message))
        estimator = self._estimator
        if estimator is None:
            return said
        flight = self.flights[-1]
        if isinstance(message, VehicleState):
            flight.has_height = flight.has_height or message.agl_m is not None
        elif isinstance(message, Odometry) and any(isinstance(s, NavEstimate) for s in said):
            flight.node_of[message.frame_id] = flight.graph.newest
            flight.lens, flight.middle = estimator.lens_learnt, estimator.middle
        elif isinstance(message, MapMatch):
            verdict = next((s.verdict for s in said if isinstance(s, MeasurementVerdict)), Verdict.STALE)
            self._note(message, verdict, estimator)
        return said

    def _note(self, match: MapMatch, verdict: Verdict, estimator: Estimator) -> None:
        flight = self.flights[-1]
        node = flight.node_of.get(match.frame_id)
        if node is not None:
            flight.doubt_m[node] = estimator.hypotheses.anywhere_m
        if node is None or match.verdict is not Verdict.ACCEPTED or not determined(match):
            said = match.verdict if match.verdict is not Verdict.ACCEPTED else Verdict.STALE
            flight.refused[str(said)] = flight.refused.get(str(said), 0) + 1
            return
        pose, cov = measured_pose(match, estimator.terrain)
        tried = verdict is not Verdict.AMBIGUOUS
        flight.fixes.append(
            Fix(node, pose, cov, match.map_sigma_m, match.coarse, moved_by_lens(match), match.lens, tried)
        )
