"""The one graph: iSAM2 in a fixed lag of nodes; what leaves it is kept for the refinement after landing (past.py).

A node is a frame: C_k, the camera pose in the world, B_k, the slow errors, and V_k, the velocity (see factors.py)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors import leg_factor, same_ground_factor
from terrafix.estimator.motion import RelativePose
from terrafix.estimator.past import Past
from terrafix.estimator.velocity import V_SIZE, Leg, standing_cov, unknown_cov

# ON-3: 10-20 keyframes. So many, and up to a batch more: marginalising the oldest makes iSAM2 eliminate nearly the
# whole window anew, so that it is done for several nodes at a time.
LAG_NODES, BATCH_NODES = 15, 5
ROBUST_K = 2.0  # Huber on motion and map factors: what passed its gate but sits in the tail pulls less
LEFT_TO_LEG_M = 1e4  # 1-sigma of a guessed way, which its leg says already
# Steps from which a factor is linearised anew. Angles bend the geometry; metres and metres per second hardly do.
RELINEARIZE = {
    "c": np.array([0.03, 0.03, 0.03, 1.0, 1.0, 1.0]),
    "b": np.array([0.03, 0.03, 0.03, 10.0]),
    "v": np.full(V_SIZE, 100.0),
}
# Random walk of the slow errors per square root of a second: mount tilt (a gimbal creeps), compass, barometer and
# the terrain under it.
WALK_SIGMAS = np.array([np.radians(0.15), np.radians(0.15), np.radians(1.0), 0.5])


@dataclass(frozen=True)
class NodeState:
    pose: gtsam.Pose3
    bias: np.ndarray  # (4,)
    velocity: np.ndarray  # (6,) V_k


class PoseGraph:
    def __init__(self) -> None:
        self._past = Past()
        self.rebuilds = 0
        self._smoother = _smoother()
        self._values: gtsam.Values | None = None  # estimate of the window; None: not computed since the last update
        self._times: dict[int, float] = {}  # nodes in the window: measurement time, s
        self._stamps: dict[int, int] = {}  # node -> batch at whose arrival it was new, or kept
        self._next = 0

    @property
    def newest(self) -> int:
        return self._next - 1

    @property
    def all_factors(self) -> gtsam.NonlinearFactorGraph:
        """Of the whole flight."""
        return self._past.all_factors()

    @property
    def all_values(self) -> gtsam.Values:
        """Newest estimate of every node."""
        self._keep_window()
        return self._past.values

    @property
    def next_node(self) -> int:
        return self._next

    def holds(self, node: int) -> bool:
        return node in self._times

    def state(self, node: int) -> NodeState:
        """Newest estimate of a node, in the window or before it."""
        values = self._estimate() if node in self._times else self._past.values
        pose = values.atPose3(C(node))
        # Rounding makes rotations drift off SO(3), and every frame builds on the last one: the drift would double.
        upright = gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
        return NodeState(upright, values.atVector(B(node)), values.atVector(V(node)))

    def _estimate(self) -> gtsam.Values:
        """Of the whole window, computed once after each update."""
        if self._values is None:
            self._values = self._smoother.calculateEstimate()
        return self._values

    def covariance(self, node: int) -> np.ndarray:
        """Marginal of C_node, 6x6, tangent order (rotation, translation); asked of the smoother itself."""
        return self._smoother.marginalCovariance(C(node))

    def velocity_covariance(self, node: int) -> np.ndarray:
        """Marginal of V_node, 6x6."""
        return self._smoother.marginalCovariance(V(node))

    def bias_covariance(self, node: int) -> np.ndarray:
        return self._smoother.marginalCovariance(B(node))

    def time_of(self, node: int) -> float:
        """Measurement time of a node in the window, s."""
        return self._times[node]

    def start(
        self,
        t_s: float,
        state: NodeState,
        cov: np.ndarray,
        bias_cov: np.ndarray,
        velocity_cov: np.ndarray,
        attitude: gtsam.CustomFactor | None = None,
    ) -> int:
        """First node, or the first after a loss: priors on C (tangent covariance 6x6), B (4x4) and V (6x6).

        The past stays as it was estimated."""
        self._keep_window()
        self._smoother, self._values = _smoother(), None
        self._times.clear()
        self._stamps.clear()
        factors = gtsam.NonlinearFactorGraph()
        node = self._next
        factors.add(gtsam.PriorFactorPose3(C(node), state.pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
        factors.add(gtsam.PriorFactorVector(B(node), state.bias, gtsam.noiseModel.Gaussian.Covariance(bias_cov)))
        factors.add(
            gtsam.PriorFactorVector(V(node), state.velocity, gtsam.noiseModel.Gaussian.Covariance(velocity_cov))
        )
        if attitude is not None:
            factors.add(attitude)
        self._insert(t_s, state, factors)
        return node

    def extend(
        self,
        t_s: float,
        state: NodeState,
        parent: int,
        motion: RelativePose,
        leg: Leg | None,
        attitude: gtsam.CustomFactor | None,
    ) -> int:
        """A node that follows ``parent`` (in the window) by ``motion``, and the newest by ``leg``; None: it stands."""
        node = self._next
        newest = self.newest
        dt_s = max(t_s - self._times[newest], 1e-3)
        factors = gtsam.NonlinearFactorGraph()
        if motion.seen is None:
            between = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m)
            cov = motion.cov.copy()
            if leg is not None:
                cov[3:, 3:] += LEFT_TO_LEG_M**2 * np.eye(3)
            factors.add(gtsam.BetweenFactorPose3(C(parent), C(node), between, _robust(cov)))
        else:
            seen, keyframe = motion.seen, self.state(parent).pose
            factors.add(
                same_ground_factor(C(parent), C(node), keyframe, state.pose, seen.pairs, seen.sigma, seen.ground)
            )
        if leg is not None:
            factors.add(leg_factor((C(newest), V(newest)), (C(node), V(node)), B(node), leg))
        else:
            standing = gtsam.noiseModel.Gaussian.Covariance(standing_cov())
            factors.add(gtsam.PriorFactorVector(V(node), np.zeros(V_SIZE), standing))
        walk = gtsam.noiseModel.Diagonal.Sigmas(WALK_SIGMAS * np.sqrt(dt_s))
        factors.add(gtsam.BetweenFactorVector(B(newest), B(node), np.zeros(4), walk))
        if attitude is not None:
            factors.add(attitude)
        self._insert(t_s, state, factors)
        return node

    def add_pose(self, node: int, pose: gtsam.Pose3, cov: np.ndarray) -> None:
        """A map fix of a node in the window: camera pose with its covariance (tangent order)."""
        factors = gtsam.NonlinearFactorGraph()
        factors.add(gtsam.PriorFactorPose3(C(node), pose, _robust(cov)))
        self._update(factors, gtsam.Values(), {})

    def keep(self, node: int) -> None:
        """Holds a node of the window in it for another full lag."""
        self._stamps[node] = _stamp(self.newest)

    def next_keys(self) -> tuple[int, int]:
        return C(self._next), B(self._next)

    def refine(self) -> dict[int, tuple[gtsam.Pose3, np.ndarray]]:
        """All nodes after a batch optimisation over every factor: pose and position covariance (3x3, world)."""
        if self._next == 0:
            return {}
        self._keep_window()
        return self._past.refine(self._next)

    def _insert(self, t_s: float, state: NodeState, factors: gtsam.NonlinearFactorGraph) -> None:
        node = self._next
        leaving = [n for n, at in self._stamps.items() if at < _stamp(node) - LAG_NODES]
        if leaving:
            self._keep_window()
            self._past.leave(leaving)
        values = gtsam.Values()
        values.insert(C(node), state.pose)
        values.insert(B(node), state.bias)
        values.insert(V(node), state.velocity)
        self._past.values.insert(values)
        self._next += 1
        self._times[node] = t_s
        self._stamps[node] = _stamp(node)
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {
            key(n): float(at) for n, at in self._stamps.items() for key in (C, B, V)
        }
        self._update(factors, values, stamps)
        for n in leaving:
            del self._times[n], self._stamps[n]

    def _update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: Mapping[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex],
    ) -> None:
        self._past.add(factors)
        self._values = None
        try:
            self._smoother.update(factors, values, stamps)
            healthy = bool(np.isfinite(self.state(self.newest).pose.matrix()).all())
        except RuntimeError:  # how GTSAM says that a system is indeterminate
            healthy = False
        if not healthy:
            self._rebuild()

    def _rebuild(self) -> None:
        self.rebuilds += 1
        node = self.newest
        self._values = None
        kept = self._past.values
        state = NodeState(kept.atPose3(C(node)), kept.atVector(B(node)), kept.atVector(V(node)))
        self._smoother = _smoother()
        t_s = self._times[node]
        self._times, self._stamps = {node: t_s}, {node: _stamp(node)}
        factors = gtsam.NonlinearFactorGraph()
        wide = np.array([0.1, 0.1, 0.2, 50.0, 50.0, 20.0])
        factors.add(gtsam.PriorFactorPose3(C(node), state.pose, gtsam.noiseModel.Diagonal.Sigmas(wide)))
        slow = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.1, 5.0]))
        factors.add(gtsam.PriorFactorVector(B(node), state.bias, slow))
        speed = gtsam.noiseModel.Gaussian.Covariance(unknown_cov())
        factors.add(gtsam.PriorFactorVector(V(node), state.velocity, speed))
        values = gtsam.Values()
        values.insert(C(node), state.pose)
        values.insert(B(node), state.bias)
        values.insert(V(node), state.velocity)
        self._smoother.update(factors, values, {key(node): float(_stamp(node)) for key in (C, B, V)})

    def _keep_window(self) -> None:
        """The estimate of the window, among those of the whole flight."""
        if not self._times:
            return
        estimate, kept = self._estimate(), self._past.values
        for node in self._times:
            kept.update(C(node), estimate.atPose3(C(node)))
            kept.update(B(node), estimate.atVector(B(node)))
            kept.update(V(node), estimate.atVector(V(node)))


def _stamp(node: int) -> int:
    """Nodes of one batch leave the window together."""
    return node - node % BATCH_NODES


def _smoother() -> gtsam.IncrementalFixedLagSmoother:
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")  # Cholesky gives up on long stretches without an absolute fix
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, limits in RELINEARIZE.items():
        thresholds.insert((letter, limits))
    params.setRelinearizeThreshold(thresholds)
    params.relinearizeSkip = 1  # looked for at every update; the thresholds make it rare
    return gtsam.IncrementalFixedLagSmoother(float(LAG_NODES), params)


def _robust(cov: np.ndarray) -> gtsam.noiseModel.Robust:
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov))
