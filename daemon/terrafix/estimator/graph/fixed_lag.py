"""Fixed-lag smoother: iSAM2 over the newest nodes; older ones are marginalised.

GTSAM's IncrementalFixedLagSmoother does the same, but its elimination order puts the newest variables anywhere when
others leave, and the two updates after that eliminate nearly everything again. Here older nodes are always eliminated
before newer ones, so that the nodes that leave are leaves of the tree and nothing else is relinearised."""

from functools import lru_cache

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.core.limits import WINDOW_NODES
from terrafix.estimator.state import MOTION_SIZE

# Least lag and batch, in nodes: requirement ON-3 asks for 10 to 20 keyframes. iSAM2 marginalises and orders nodes by
# the batch, so the window holds up to a batch more. [spec: ON-3]
BATCH_NODES = 5
# Changes of a variable from which its factors are relinearised (rad, m; B_k; V_k). Angles make the geometry nonlinear;
# metres and metres per second hardly do. [tuned]
RELINEARIZE = {
    "c": np.array([0.03, 0.03, 0.03, 1.0, 1.0, 1.0]),
    "b": np.array([0.03, 0.03, 0.03, 10.0, 1.0, 0.05]),
    "v": np.full(MOTION_SIZE, 100.0),
}
# Change below which iSAM2 does not update older variables. Its default of 0.001 is 0.06 degrees, a fifth of a usual
# heading error. [tuned]
WILDFIRE = 1e-6


class FixedLagSmoother:
    """Raises RuntimeError, as GTSAM does, for an indeterminate system; the object cannot be used after that."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        exact = gtsam.ISAM2GaussNewtonParams()
        exact.setWildfireThreshold(WILDFIRE)
        params.setOptimizationParams(exact)
        params.setFactorization("QR")  # Cholesky fails on long stretches without an absolute fix
        thresholds = gtsam.ISAM2ThresholdMap()
        for letter, limits in RELINEARIZE.items():
            thresholds.insert((letter, limits))
        params.setRelinearizeThreshold(thresholds)
        params.findUnusedFactorSlots = True  # otherwise the list of factors grows with the flight
        params.relinearizeSkip = 1  # checked at every update; the thresholds make relinearization rare
        self._isam = gtsam.ISAM2(params)
        self._batches: dict[int, int] = {}  # node -> batch in which it was added or last retained
        self._reordered: set[int] = set()  # nodes whose place in the elimination order has changed

    def leaving(self, node: int) -> list[int]:
        """The nodes that leave when ``node`` is added."""
        first = (node // BATCH_NODES) - WINDOW_NODES // BATCH_NODES
        return [n for n, batch in self._batches.items() if batch < first]

    def keep(self, node: int) -> None:
        """Retains a node for another full lag."""
        newest = max(self._batches.values())
        if self._batches[node] != newest:
            self._batches[node] = newest
            self._reordered.add(node)

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        """Adds factors of nodes in the window."""
        self._update(factors, gtsam.Values())

    def insert(self, node: int, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Adds the newest node with its factors, and marginalises the nodes that leave (``leaving``)."""
        leaving = self.leaving(node)
        self._batches[node] = node // BATCH_NODES
        self._update(factors, values)
        if leaving:
            leaves = gtsam.KeyList()
            for n in leaving:
                del self._batches[n]
                for key in _keys(n):
                    leaves.push_back(key)
            self._isam.marginalizeLeaves(leaves)

    def _update(self, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """Orders variables that are eliminated again by batch, with the newest node last, because most queries are for
        it. So only variables of the same batch or an older one are below a node in the tree, and leave with it.

        The two newest nodes are always reordered: COLAMD takes no more groups than there are variables."""
        oldest = min(self._batches.values())
        newest = sorted(self._batches)[-2:]
        groups, reordered = gtsam.KeyGroupMap(), gtsam.KeyList()
        add_to_group = groups.insert2
        for n, batch in self._batches.items():
            keys, group = _keys(n), batch - oldest + (n == newest[-1])
            for key in keys:
                add_to_group(key, group)
            if n in newest or n in self._reordered:
                for key in keys:
                    if not values.exists(key):
                        reordered.push_back(key)
        self._reordered.clear()
        self._isam.update(factors, values, [], groups, None, reordered)

    def estimate(self) -> gtsam.Values:
        """Newest estimate of all variables in the window."""
        return self._isam.calculateEstimate()

    def linearization_point(self) -> gtsam.Values:
        """Linearisation point of all factors in the window: within RELINEARIZE of the estimate."""
        return self._isam.getLinearizationPoint()

    def pose(self, node: int) -> gtsam.Pose3:
        """Estimate of C."""
        return self._isam.calculateEstimatePose3(C(node))

    def vector(self, key: int) -> np.ndarray:
        """Estimate of a B or a V."""
        return self._isam.calculateEstimateVector(key)

    def marginal(self, key: int) -> np.ndarray:
        """Marginal covariance of a variable."""
        return self._isam.marginalCovariance(key)

    def joint_marginal(self, node: int) -> np.ndarray:
        """Joint marginal covariance of C, B and V of a node, in this order."""
        return self._isam.jointMarginalCovariance(_keys(node)).fullMatrix()

    def joint_pose_marginal(self, first: int, second: int) -> np.ndarray:
        """Joint marginal covariance of C of two nodes, in this order."""
        joint = self._isam.jointMarginalCovariance([C(first), C(second)])
        return np.block([[joint.at(C(a), C(b)) for b in (first, second)] for a in (first, second)])


@lru_cache(maxsize=4 * WINDOW_NODES)
def _keys(node: int) -> tuple[int, int, int]:
    return C(node), B(node), V(node)
