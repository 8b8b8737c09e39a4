"""iSAM2 over the newest nodes; what leaves is marginalised.

GTSAM's IncrementalFixedLagSmoother does the same, but its order of elimination puts the newest variables anywhere when
others leave: the two updates after that eliminate nearly everything again. Here older nodes are always eliminated
before newer ones, so that those that leave are the leaves of the tree, and nothing else is asked again."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.models.motion_model import V_SIZE

# ON-3: 10-20 keyframes. So many, and up to a batch more: iSAM2 takes nodes out, and puts them in order, by the batch.
LAG_NODES, BATCH_NODES = 15, 5
# Steps from which a factor is linearised anew. Angles bend the geometry; metres and metres per second hardly do.
RELINEARIZE = {
    "c": np.array([0.03, 0.03, 0.03, 1.0, 1.0, 1.0]),
    "b": np.array([0.03, 0.03, 0.03, 10.0, 1.0, 0.05]),
    "v": np.full(V_SIZE, 100.0),
}
# A change below which iSAM2 looks at no older variable. Its own 0.001 is 0.06 degrees: a fifth of what headings err by.
WILDFIRE = 1e-6


class FixedLagSmoother:
    """Raises RuntimeError, as GTSAM does, when the system is indeterminate: it is of no use any more."""

    def __init__(self) -> None:
        params = gtsam.ISAM2Params()
        exact = gtsam.ISAM2GaussNewtonParams()
        exact.setWildfireThreshold(WILDFIRE)
        params.setOptimizationParams(exact)
        params.setFactorization("QR")  # Cholesky gives up on long stretches without an absolute fix
        thresholds = gtsam.ISAM2ThresholdMap()
        for letter, limits in RELINEARIZE.items():
            thresholds.insert((letter, limits))
        params.setRelinearizeThreshold(thresholds)
        params.findUnusedFactorSlots = True  # or its lists of factors grow with the flight
        params.relinearizeSkip = 1  # looked for at every update; the thresholds make it rare
        self._isam = gtsam.ISAM2(params)
        self._batches: dict[int, int] = {}  # node -> in which it came, or was kept
        self._again: set[int] = set()  # nodes whose place in the order has changed

    def leaving(self, node: int) -> list[int]:
        """The nodes that leave when ``node`` comes."""
        first = (node // BATCH_NODES) - LAG_NODES // BATCH_NODES
        return [n for n, batch in self._batches.items() if batch < first]

    def keep(self, node: int) -> None:
        """Holds it for another full lag."""
        newest = max(self._batches.values())
        if self._batches[node] != newest:
            self._batches[node] = newest
            self._again.add(node)

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        """Of nodes that are there."""
        self._update(factors, gtsam.Values())

    def insert(self, node: int, factors: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        """The newest node, with its factors. Others leave (``leaving``)."""
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
        """What is eliminated again is put in the order of the batches, the newest node last, of which most is asked.
        So nothing but what came in its own batch or an older one is ever below a node in the tree, and leaves with it.

        The two newest nodes are always among it: COLAMD takes no more groups than there are variables."""
        oldest = min(self._batches.values())
        newest = sorted(self._batches)[-2:]
        groups, again = gtsam.KeyGroupMap(), gtsam.KeyList()
        for n, batch in self._batches.items():
            for key in _keys(n):
                groups.insert2(key, batch - oldest + (n == newest[-1]))
                if (n in newest or n in self._again) and not values.exists(key):
                    again.push_back(key)
        self._again.clear()
        self._isam.update(factors, values, [], groups, None, again)

    def estimate(self) -> gtsam.Values:
        """Of everything."""
        return self._isam.calculateEstimate()

    def linear_around(self) -> gtsam.Values:
        """Where its factors are linear: nearer to the estimate than RELINEARIZE says."""
        return self._isam.getLinearizationPoint()

    def pose(self, node: int) -> gtsam.Pose3:
        return self._isam.calculateEstimatePose3(C(node))

    def vector(self, key: int) -> np.ndarray:
        return self._isam.calculateEstimateVector(key)

    def marginal(self, key: int) -> np.ndarray:
        return self._isam.marginalCovariance(key)


def _keys(node: int) -> tuple[int, int, int]:
    return C(node), B(node), V(node)
