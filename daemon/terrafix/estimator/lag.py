"""iSAM2 over the newest nodes; what leaves is marginalised.

GTSAM's IncrementalFixedLagSmoother does the same, but its order of elimination puts the newest variables anywhere when
others leave: the two updates after that eliminate nearly everything again. Here they stay at the root of the tree."""

from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.velocity import V_SIZE

# Steps from which a factor is linearised anew. Angles bend the geometry; metres and metres per second hardly do.
RELINEARIZE = {
    "c": np.array([0.03, 0.03, 0.03, 1.0, 1.0, 1.0]),
    "b": np.array([0.03, 0.03, 0.03, 10.0, 1.0, 0.05]),
    "v": np.full(V_SIZE, 100.0),
}
_LEAVING, _STAYING, _NEWEST = 0, 1, 2  # groups in the order of elimination


class FixedLag:
    """Raises RuntimeError, as GTSAM does, when the system is indeterminate: it is of no use any more."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        params.setFactorization("QR")  # Cholesky gives up on long stretches without an absolute fix
        thresholds = gtsam.ISAM2ThresholdMap()
        for letter, limits in RELINEARIZE.items():
            thresholds.insert((letter, limits))
        params.setRelinearizeThreshold(thresholds)
        params.findUnusedFactorSlots = True  # or its lists of factors grow with the flight
        params.relinearizeSkip = 1  # looked for at every update; the thresholds make it rare
        self._isam = gtsam.ISAM2(params)
        self._nodes: set[int] = set()

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        """Of nodes that are there."""
        self._isam.update(factors, gtsam.Values())

    def insert(
        self, node: int, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, leaving: Iterable[int] = ()
    ) -> None:
        """The newest node, with its factors; ``leaving`` are marginalised."""
        gone = set(leaving)
        if not gone:
            self._isam.update(factors, values)
            self._nodes.add(node)
            return
        groups, again, leaves = gtsam.KeyGroupMap(), gtsam.KeyList(), gtsam.KeyList()
        for n in self._nodes | {node}:
            for key in (C(n), B(n), V(n)):
                groups.insert2(key, _LEAVING if n in gone else _NEWEST if n == node else _STAYING)
                if n != node:
                    again.push_back(key)  # all are eliminated anew: where they hang on those that leave is not asked
                if n in gone:
                    leaves.push_back(key)
        self._isam.update(factors, values, [], groups, None, again)
        self._isam.marginalizeLeaves(leaves)
        self._nodes = (self._nodes | {node}) - gone

    def estimate(self) -> gtsam.Values:
        """Of everything."""
        return self._isam.calculateEstimate()

    def pose(self, node: int) -> gtsam.Pose3:
        return self._isam.calculateEstimatePose3(C(node))

    def vector(self, key: int) -> np.ndarray:
        return self._isam.calculateEstimateVector(key)

    def marginal(self, key: int) -> np.ndarray:
        return self._isam.marginalCovariance(key)
