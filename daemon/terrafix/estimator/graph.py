"""The one graph: iSAM2 in a fixed lag of nodes, and the list of all factors for the refinement after landing.

A node is a frame that moved on: C_k, the camera pose in the world, and B_k, the slow errors (see factors.py)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C

from terrafix.estimator.factors import same_ground_factor
from terrafix.estimator.motion import RelativePose

LAG_NODES = 20.0  # ON-3: 10-20 keyframes
ROBUST_K = 2.0  # Huber on motion and map factors: what passed its gate but sits in the tail pulls less
# Random walk of the slow errors per square root of a second: mount tilt (a gimbal creeps), compass, barometer and
# the terrain under it.
WALK_SIGMAS = np.array([np.radians(0.15), np.radians(0.15), np.radians(1.0), 0.5])


@dataclass(frozen=True)
class NodeState:
    pose: gtsam.Pose3
    bias: np.ndarray  # (4,)


class PoseGraph:
    def __init__(self) -> None:
        self.all_factors = gtsam.NonlinearFactorGraph()
        self.all_values = gtsam.Values()
        self.rebuilds = 0
        self._smoother = _smoother()
        self._times: dict[int, float] = {}  # nodes in the window: measurement time, s
        self._stamps: dict[int, int] = {}  # node -> the node at whose arrival it was new, or kept
        self._next = 0

    @property
    def newest(self) -> int:
        return self._next - 1

    @property
    def next_node(self) -> int:
        return self._next

    def holds(self, node: int) -> bool:
        return node in self._times

    def state(self, node: int) -> NodeState:
        """Newest estimate of a node, in the window or before it."""
        values = self._smoother.calculateEstimate() if node in self._times else self.all_values
        pose = values.atPose3(C(node))
        # Rounding makes rotations drift off SO(3), and every frame builds on the last one: the drift would double.
        upright = gtsam.Pose3(gtsam.Rot3.ClosestTo(pose.rotation().matrix()), pose.translation())
        return NodeState(upright, values.atVector(B(node)))

    def covariance(self, node: int) -> np.ndarray:
        """Marginal of C_node, 6x6, tangent order (rotation, translation); asked of the smoother itself."""
        return self._smoother.marginalCovariance(C(node))

    def relative_covariance(self, a: int, b: int) -> np.ndarray:
        """Of the way from node a to node b, 3x3, world axes: what their common error leaves."""
        joint = self._smoother.getISAM2().jointMarginalCovariance([C(a), C(b)])
        r_a = self.state(a).pose.rotation().matrix()
        r_b = self.state(b).pose.rotation().matrix()
        cross = r_a @ joint.at(C(a), C(b))[3:, 3:] @ r_b.T
        own_a = r_a @ joint.at(C(a), C(a))[3:, 3:] @ r_a.T
        own_b = r_b @ joint.at(C(b), C(b))[3:, 3:] @ r_b.T
        return np.asarray(own_a + own_b - cross - cross.T)

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
        attitude: gtsam.CustomFactor | None = None,
    ) -> int:
        """First node, or the first after a loss: priors on C (tangent covariance 6x6) and B (4x4).

        The past stays as it was estimated."""
        self._keep_window()
        self._smoother = _smoother()
        self._times.clear()
        self._stamps.clear()
        factors = gtsam.NonlinearFactorGraph()
        node = self._next
        factors.add(gtsam.PriorFactorPose3(C(node), state.pose, gtsam.noiseModel.Gaussian.Covariance(cov)))
        factors.add(gtsam.PriorFactorVector(B(node), state.bias, gtsam.noiseModel.Gaussian.Covariance(bias_cov)))
        if attitude is not None:
            factors.add(attitude)
        self._insert(t_s, state, factors)
        return node

    def extend(
        self, t_s: float, state: NodeState, parent: int, motion: RelativePose, attitude: gtsam.CustomFactor | None
    ) -> int:
        """A node that follows ``parent`` (in the window) by ``motion``."""
        node = self._next
        newest = self.newest
        dt_s = max(t_s - self._times[newest], 1e-3)
        factors = gtsam.NonlinearFactorGraph()
        if motion.seen is None:
            between = gtsam.Pose3(gtsam.Rot3.ClosestTo(motion.r), motion.p_m)
            factors.add(gtsam.BetweenFactorPose3(C(parent), C(node), between, _robust(motion.cov)))
        else:
            seen, keyframe = motion.seen, self.state(parent).pose
            factors.add(
                same_ground_factor(C(parent), C(node), keyframe, state.pose, seen.pairs, seen.sigma, seen.ground)
            )
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
        self._stamps[node] = self.newest

    def next_keys(self) -> tuple[int, int]:
        return C(self._next), B(self._next)

    def refine(self) -> dict[int, tuple[gtsam.Pose3, np.ndarray]]:
        """All nodes after a batch optimisation over every factor: pose and position covariance (3x3, world)."""
        self._keep_window()
        if self._next == 0:
            return {}
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(30)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        try:
            values = gtsam.LevenbergMarquardtOptimizer(self.all_factors, self.all_values, params).optimize()
            marginals = gtsam.Marginals(self.all_factors, values)
        except RuntimeError:  # how GTSAM says that a system is indeterminate: what was said in flight stands
            return {}
        refined = {}
        for node in range(self._next):
            pose = values.atPose3(C(node))
            r = pose.rotation().matrix()
            refined[node] = (pose, r @ marginals.marginalCovariance(C(node))[3:, 3:] @ r.T)
        return refined

    def _insert(self, t_s: float, state: NodeState, factors: gtsam.NonlinearFactorGraph) -> None:
        node = self._next
        values = gtsam.Values()
        values.insert(C(node), state.pose)
        values.insert(B(node), state.bias)
        self.all_values.insert(values)
        self._next += 1
        self._times[node] = t_s
        self._stamps[node] = node
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {
            key(n): float(at) for n, at in self._stamps.items() for key in (C, B)
        }
        leaving = [n for n, at in self._stamps.items() if at < node - LAG_NODES]
        if leaving:
            self._remember(leaving)
        self._update(factors, values, stamps)
        for n in leaving:
            del self._times[n], self._stamps[n]

    def _update(
        self,
        factors: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        stamps: Mapping[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex],
    ) -> None:
        self.all_factors.push_back(factors)
        try:
            self._smoother.update(factors, values, stamps)
            self._smoother.update()  # a second pass relinearises what the first one moved
            healthy = bool(np.isfinite(self.state(self.newest).pose.matrix()).all())
        except RuntimeError:  # how GTSAM says that a system is indeterminate
            healthy = False
        if not healthy:
            self._rebuild()

    def _rebuild(self) -> None:
        self.rebuilds += 1
        node = self.newest
        state = NodeState(self.all_values.atPose3(C(node)), self.all_values.atVector(B(node)))
        self._smoother = _smoother()
        t_s = self._times[node]
        self._times, self._stamps = {node: t_s}, {node: node}
        factors = gtsam.NonlinearFactorGraph()
        wide = np.array([0.1, 0.1, 0.2, 50.0, 50.0, 20.0])
        factors.add(gtsam.PriorFactorPose3(C(node), state.pose, gtsam.noiseModel.Diagonal.Sigmas(wide)))
        slow = gtsam.noiseModel.Diagonal.Sigmas(np.array([0.1, 0.1, 0.1, 5.0]))
        factors.add(gtsam.PriorFactorVector(B(node), state.bias, slow))
        values = gtsam.Values()
        values.insert(C(node), state.pose)
        values.insert(B(node), state.bias)
        self._smoother.update(factors, values, {C(node): float(node), B(node): float(node)})

    def _remember(self, nodes: list[int]) -> None:
        estimate = self._smoother.calculateEstimate()
        for node in nodes:
            self.all_values.update(C(node), estimate.atPose3(C(node)))
            self.all_values.update(B(node), estimate.atVector(B(node)))

    def _keep_window(self) -> None:
        if self._times:
            self._remember(list(self._times))


def _smoother() -> gtsam.IncrementalFixedLagSmoother:
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")  # Cholesky gives up on long stretches without an absolute fix
    params.setRelinearizeThreshold(0.05)
    return gtsam.IncrementalFixedLagSmoother(LAG_NODES, params)


def _robust(cov: np.ndarray) -> gtsam.noiseModel.Robust:
    huber = gtsam.noiseModel.mEstimator.Huber.Create(ROBUST_K)
    return gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Gaussian.Covariance(cov))
