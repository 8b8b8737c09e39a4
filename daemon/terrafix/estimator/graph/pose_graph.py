"""The estimator's factor graph: iSAM2 over a fixed lag of nodes. What leaves the lag is kept as a linear system for the
refinement after landing (marginalized.py).

A node is one frame with the variables C_k, B_k and V_k (terrafix.estimator.state)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors.motion import motion_factor
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.factors.plane_two_view import plane_two_view_factor
from terrafix.estimator.factors.three_view import ThreeViewConstraint, three_view_factor
from terrafix.estimator.graph.elimination import NODE_SIZE, graph_of, values_of
from terrafix.estimator.graph.fixed_lag import FixedLagSmoother
from terrafix.estimator.graph.marginalized import MarginalizedHistory
from terrafix.estimator.models.bias_walk import walk_sigmas
from terrafix.estimator.models.lens_prior import RADIAL_K1_SIGMA
from terrafix.estimator.models.motion_model import MotionIncrement, stationary_motion_cov, unknown_motion_cov
from terrafix.estimator.models.plane_motion import MatchedRays, RelativePose
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE, TRANSLATION, UP, NodeState

LOOSE_TRANSLATION_M = 1e4  # 1-sigma of a predicted translation, which the motion increment constrains already [tuned]
MIN_STEP_S = 1e-3  # lower bound of the time between nodes [tuned]
# 1-sigma of C (rad, m) after a rebuild, in tangent order: much less certain than any estimate in flight. [tuned]
REBUILD_POSE_SIGMAS = np.array([0.1, 0.1, 0.2, 50.0, 50.0, 20.0])
REBUILD_CALIBRATION_SIGMAS = np.array([0.1, 0.1, 0.1, 5.0, RADIAL_K1_SIGMA, 0.1])  # ... and of B [tuned]


@dataclass(frozen=True)
class GraphPrior:
    """First node of a graph: ``cov`` (6, 6) of its pose in tangent order, ``calibration_cov`` (6, 6) of B,
    ``motion_cov`` (8, 8) of V, and a factor of the reported attitude and height. ``gauge_fixed_cov`` (6, 6): enters the
    graph instead of ``cov`` where part of the pose is unobservable and fixed by choice (yaw_gauge.py)."""

    state: NodeState
    cov: np.ndarray
    calibration_cov: np.ndarray
    motion_cov: np.ndarray
    attitude: gtsam.CustomFactor | None = None
    gauge_fixed_cov: np.ndarray | None = None

    @property
    def pose_cov(self) -> np.ndarray:
        """(6, 6) of the pose, as it enters the graph."""
        return self.cov if self.gauge_fixed_cov is None else self.gauge_fixed_cov

    @property
    def node_covariance(self) -> np.ndarray:
        """(NODE_SIZE, NODE_SIZE), in the order C, B, V."""
        cov, end = np.zeros((NODE_SIZE, NODE_SIZE)), 0
        for block in (self.pose_cov, self.calibration_cov, self.motion_cov):
            begin, end = end, end + len(block)
            cov[begin:end, begin:end] = block
        return cov


@dataclass(frozen=True)
class NewNode:
    """A node that is tied to ``parent`` (in the window) by ``motion``, and to the newest node by ``increment``; None:
    the vehicle is stationary. ``rise_sigma_m``: change of ground elevation since the newest node, without a DEM.
    ``three_view``: an earlier node, and the constraint of that node, ``parent`` and this one. ``motion_cov`` (8, 8):
    V of the node is known to this, independently of the nodes before; None: through ``increment``. ``links``: further
    nodes that stay in the window, and the matched rays of this one with them."""

    state: NodeState
    parent: int
    motion: RelativePose
    increment: MotionIncrement | None
    attitude: gtsam.CustomFactor | None
    rise_sigma_m: float = 0.0
    three_view: tuple[int, ThreeViewConstraint] | None = None
    motion_cov: np.ndarray | None = None
    links: tuple[tuple[int, MatchedRays], ...] = ()


@dataclass(frozen=True)
class NodeTies:
    """Factors by which the newest node was tied to its parent (``odometry``) and to the node before (``motion``)."""

    odometry: gtsam.NonlinearFactor
    motion: gtsam.NoiseModelFactor


class GraphObserver:
    """Is called before each change of the graph. This one does nothing; post-flight analysis records the nodes."""

    def before_node(self, graph: "PoseGraph") -> None:
        """A node is about to be added, and others leave the window."""

    def started(self, graph: "PoseGraph", t_s: float, prior: GraphPrior, others: list[gtsam.NonlinearFactor]) -> None:
        """``others``: all factors of the first node but the prior of its pose."""

    def extended(
        self,
        graph: "PoseGraph",
        t_s: float,
        new: NewNode,
        odometry: gtsam.NonlinearFactor,
        others: list[gtsam.NonlinearFactor],
    ) -> None:
        """``others``: all factors of the node but that of ``odometry``."""


class PoseGraph:
    """``rebuilds``: how often the smoother failed and was built anew from the last good estimate. ``ties``: of the
    newest node that was added by ``extend``; None: there was none, or the graph was built anew since."""

    def __init__(self, history: MarginalizedHistory | None = None, observer: GraphObserver | None = None) -> None:
        self._observer = observer or GraphObserver()
        self._history = history or MarginalizedHistory()
        self._last_good = gtsam.Values()  # estimate of the window before the newest nodes were added
        self.rebuilds = 0
        self.ties: NodeTies | None = None
        self._smoother = FixedLagSmoother()
        self._states: dict[int, NodeState] = {}  # cache, cleared by each update
        self._marginals: dict[int, np.ndarray] = {}  # cache by key, cleared by each update
        self._times: dict[int, float] = {}  # nodes in the window -> measurement time, s
        self._next = 0

    @property
    def newest(self) -> int:
        return self._next - 1

    @property
    def next_node(self) -> int:
        return self._next

    @property
    def window(self) -> tuple[int, ...]:
        """Nodes in the window."""
        return tuple(self._times)

    def holds(self, node: int) -> bool:
        """Whether the node is in the window."""
        return node in self._times

    @property
    def leaving(self) -> list[int]:
        """Nodes that leave the window when the next one is added."""
        return self._smoother.leaving(self._next)

    def state(self, node: int) -> NodeState:
        """Newest estimate of a node in the window."""
        if node not in self._states:
            pose = self._smoother.pose(node)
            # Rounding moves rotations off SO(3), and each frame builds on the last one: without this the error doubles.
            orthonormal = gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
            calibration, motion = (self._smoother.vector(key(node)) for key in (B, V))
            self._states[node] = NodeState(orthonormal, calibration, motion)
        return self._states[node]

    def linearization(self, node: int) -> NodeState:
        """Where the factors of a node in the window are linearised, and robust ones get their weight."""
        at = self._smoother.linearization_point()
        return NodeState(at.atPose3(C(node)), at.atVector(B(node)), at.atVector(V(node)))

    @property
    def motion_weight(self) -> float:
        """Robust weight of the motion factor of the newest node, at its linearization; 1 where it is not robust, and
        where the node has none since the graph was built anew."""
        if self.ties is None:
            return 1.0
        residual = self.ties.motion.unwhitenedError(self._smoother.linearization_point())
        noise = self.ties.motion.noiseModel()
        return float(noise.weight(noise.unweightedWhiten(residual)))

    def covariance(self, node: int) -> np.ndarray:
        """Marginal of C, (6, 6), tangent order, from the smoother."""
        return self._marginal(C(node))

    def motion_covariance(self, node: int) -> np.ndarray:
        """Marginal of V, (8, 8)."""
        return self._marginal(V(node))

    def calibration_covariance(self, node: int) -> np.ndarray:
        """Marginal of B, (6, 6)."""
        return self._marginal(B(node))

    def joint_covariance(self, node: int) -> np.ndarray:
        """Joint marginal (NODE_SIZE, NODE_SIZE) of C, B and V of a node in the window."""
        return self._smoother.joint_marginal(node)

    def joint_pose_covariance(self, first: int, second: int) -> np.ndarray:
        """Joint marginal (12, 12) of C of two nodes in the window, in this order, tangent order each."""
        return self._smoother.joint_pose_marginal(first, second)

    def _marginal(self, key: int) -> np.ndarray:
        if key not in self._marginals:
            self._marginals[key] = self._smoother.marginal(key)
        return self._marginals[key].copy()

    def time_of(self, node: int) -> float:
        """Measurement time of a node in the window, s."""
        return self._times[node]

    def since_newest_s(self, t_s: float) -> float:
        """Time from the newest node to ``t_s``, MIN_STEP_S at least."""
        return self.since_s(self.newest, t_s)

    def since_s(self, node: int, t_s: float) -> float:
        """Time from a node in the window to ``t_s``, MIN_STEP_S at least."""
        return max(t_s - self._times[node], MIN_STEP_S)

    def start(self, t_s: float, prior: GraphPrior) -> int:
        """Begins a new graph with one node. Nodes so far become history, as they were estimated. -> the node."""
        self._observer.before_node(self)
        node = self._next
        self._marginalize_all()
        self._new_smoother()
        pose_prior, others = _prior_factors(node, prior)
        self._observer.started(self, t_s, prior, others)
        self._insert(t_s, prior.state, [pose_prior, *others])
        return node

    def extend(self, t_s: float, new: NewNode) -> int:
        """Adds a node. -> the node."""
        self._observer.before_node(self)
        node, others = self._next, list[gtsam.NonlinearFactor]()
        odometry = self._odometry_factor(node, new)
        self.ties = NodeTies(odometry, self._motion_factor(node, new))
        others.append(self.ties.motion)
        others.append(self._walk_factor(node, self.newest, t_s, new))
        if new.attitude is not None:
            others.append(new.attitude)
        if new.three_view is not None and new.three_view[0] not in self._smoother.leaving(node):
            first, middle, last = ((C(n), B(n)) for n in (new.three_view[0], new.parent, node))
            rises = new.rise_sigma_m > 0.0
            others.append(three_view_factor((first, middle, last), new.three_view[1], rises=rises))
        others += [self._two_view_factor(keyframe, node, new.state.pose, rays) for keyframe, rays in new.links]
        self._observer.extended(self, t_s, new, odometry, others)
        self._insert(t_s, new.state, [odometry, *others])
        return node

    def _odometry_factor(self, node: int, new: NewNode) -> gtsam.NonlinearFactor:
        motion, parent = new.motion, new.parent
        if motion.rays is None:
            cov = motion.cov.copy()
            if new.increment is not None:
                cov[TRANSLATION, TRANSLATION] += LOOSE_TRANSLATION_M**2 * np.eye(3)
            return gtsam.BetweenFactorPose3(C(parent), C(node), motion.between, robust_noise(cov))
        return self._two_view_factor(parent, node, new.state.pose, motion.rays)

    def _two_view_factor(self, keyframe: int, node: int, pose: gtsam.Pose3, rays: MatchedRays) -> gtsam.NonlinearFactor:
        """``pose``: first estimate of ``node``."""
        return plane_two_view_factor(C(keyframe), C(node), B(node), self.state(keyframe).pose, pose, rays, B(keyframe))

    def _motion_factor(self, node: int, new: NewNode) -> gtsam.NoiseModelFactor:
        newest, increment = self.newest, new.increment
        if new.motion_cov is not None:
            noise = gtsam.noiseModel.Gaussian.Covariance(new.motion_cov)
            return gtsam.PriorFactorVector(V(node), new.state.motion, noise)
        if increment is not None:
            keys = (C(newest), V(newest)), (C(node), V(node)), (B(newest), B(node))
            return motion_factor(*keys, increment, new.state.pose.rotation())
        stationary = gtsam.noiseModel.Gaussian.Covariance(stationary_motion_cov())
        return gtsam.PriorFactorVector(V(node), np.zeros(MOTION_SIZE), stationary)

    def _walk_factor(self, node: int, newest: int, t_s: float, new: NewNode) -> gtsam.NonlinearFactor:
        dt_s = self.since_newest_s(t_s)
        turned = new.state.pose.rotation().compose(self.state(newest).pose.rotation().inverse())
        sigmas = walk_sigmas(dt_s, float(gtsam.Rot3.Logmap(turned)[UP]), new.rise_sigma_m)
        walk = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        return gtsam.BetweenFactorVector(B(newest), B(node), np.zeros(CALIBRATION_SIZE), walk)

    def add(self, *new: gtsam.NonlinearFactor) -> None:
        """Adds factors of nodes in the window."""
        factors = graph_of(new)
        self._history.add(factors)
        self._update(partial(self._smoother.add, factors))

    def keep(self, node: int) -> None:
        """Retains a node in the window for another full lag."""
        self._smoother.keep(node)

    def next_keys(self) -> tuple[int, int]:
        """Keys of C and B of the node that is added next."""
        return C(self._next), B(self._next)

    def refine(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """After landing: position (N, 3), orientation (N, 3, 3) and covariance (N, 6, 6) of every node given all
        measurements, as of MarginalizedHistory."""
        self._marginalize_all()
        return self._history.refine()

    def _insert(self, t_s: float, state: NodeState, new: list[gtsam.NonlinearFactor]) -> None:
        factors = graph_of(new)
        node = self._next
        leaving = self._smoother.leaving(node)
        if leaving:
            self._last_good = self._smoother.estimate()
            self._history.marginalize(leaving, self._smoother.linearization_point())
        else:
            self._history.reduce_step()
        values = values_of({node: state})
        self._last_good.insert(values)
        self._next += 1
        self._times[node] = t_s
        for n in leaving:
            del self._times[n]
        if not any({C(node), B(node)} <= set(factors.at(i).keys()) for i in range(factors.size())):
            factors.add(_empty_factor(node))
        self._history.add(factors)
        self._update(partial(self._smoother.insert, node, factors, values))

    def _update(self, work: Callable[[], None]) -> None:
        self._states.clear()
        self._marginals.clear()
        try:
            work()
            healthy = bool(np.isfinite(self.state(self.newest).pose.matrix()).all())
        # Raised by GTSAM and by factors for an indeterminate system, and for a variable missing from the tree.
        except (RuntimeError, OverflowError, ValueError, IndexError):
            healthy = False
        if not healthy:
            self._rebuild()

    def _rebuild(self) -> None:
        """A new graph of the newest node alone, from the last good estimate, with wide priors."""
        self.rebuilds += 1
        self.ties = None
        node = self.newest
        state = NodeState(
            self._last_good.atPose3(C(node)), self._last_good.atVector(B(node)), self._last_good.atVector(V(node))
        )
        self._history.marginalize([n for n in self._times if n != node], self._last_good)
        self._history.begin_segment(node)
        self._new_smoother()
        self._times = {node: self._times[node]}
        pose_prior, others = _prior_factors(node, rebuild_prior(state))
        factors = graph_of([pose_prior, *others])
        self._history.add(factors)
        self._smoother.insert(node, factors, values_of({node: state}))

    def _new_smoother(self) -> None:
        self._smoother = FixedLagSmoother()
        self._states.clear()
        self._marginals.clear()

    def _marginalize_all(self) -> None:
        """Marginalises the whole window."""
        if self._times:
            self._history.marginalize(list(self._times), self._smoother.estimate())
        self._history.begin_segment(self._next)
        self._times.clear()


def rebuild_prior(state: NodeState) -> GraphPrior:
    """Prior of the one node of a graph that was built anew."""
    pose_cov, calibration_cov = np.diag(REBUILD_POSE_SIGMAS**2), np.diag(REBUILD_CALIBRATION_SIGMAS**2)
    return GraphPrior(state, pose_cov, calibration_cov, unknown_motion_cov())


def _empty_factor(node: int) -> gtsam.LinearContainerFactor:
    """A factor of C and B without information. ISAM2.marginalizeLeaves drops a variable that leaves together with one
    that is above it in the tree when no factor ties the two, and raises (GTSAM 4.3: it climbs to the clique of the
    latter, and removes only what is below that by name). B of the first node of a graph may be such a variable."""
    zero_row = np.zeros((1, 6))
    return gtsam.LinearContainerFactor(
        gtsam.JacobianFactor(C(node), zero_row, B(node), zero_row, np.zeros(1), gtsam.noiseModel.Unit.Create(1))
    )


def _prior_factors(node: int, prior: GraphPrior) -> tuple[gtsam.NonlinearFactor, list[gtsam.NonlinearFactor]]:
    """-> the prior of the pose, and all others of the first node of a graph."""
    gaussian = gtsam.noiseModel.Gaussian.Covariance
    pose_prior = gtsam.PriorFactorPose3(C(node), prior.state.pose, gaussian(prior.pose_cov))
    others: list[gtsam.NonlinearFactor] = [
        gtsam.PriorFactorVector(B(node), prior.state.calibration, gaussian(prior.calibration_cov)),
        gtsam.PriorFactorVector(V(node), prior.state.motion, gaussian(prior.motion_cov)),
    ]
    return pose_prior, others if prior.attitude is None else [*others, prior.attitude]
