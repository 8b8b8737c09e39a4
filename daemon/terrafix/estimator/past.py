"""What has left the window of the graph, kept for the refinement after landing.

A factor written in Python costs much there: GTSAM hands each call a copy of all values of the flight. So each is kept
as the linear factor that it is around the estimate with which it left the window: a few matrices, and no Python."""

from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C


class Past:
    """``values``: newest estimate of every node, in the window or before it."""

    def __init__(self) -> None:
        self.values = gtsam.Values()
        self._factors = gtsam.NonlinearFactorGraph()
        self._window: list[gtsam.NonlinearFactor] = []  # of which no node has left yet

    def add(self, factors: gtsam.NonlinearFactorGraph) -> None:
        self._window += [factors.at(i) for i in range(factors.size())]

    def leave(self, nodes: Iterable[int]) -> None:
        """These nodes leave the window, with the estimate that ``values`` has."""
        gone, staying = set(nodes), []
        for factor in self._window:
            if any(gtsam.symbolIndex(key) in gone for key in factor.keys()):  # noqa: SIM118 (a factor is no dict)
                self._factors.push_back(self._without_python(factor))
            else:
                staying.append(factor)
        self._window = staying

    def all_factors(self) -> gtsam.NonlinearFactorGraph:
        """Of the whole flight."""
        whole = gtsam.NonlinearFactorGraph(self._factors)
        for factor in self._window:
            whole.push_back(factor)
        return whole

    def refine(self, nodes: int) -> dict[int, tuple[gtsam.Pose3, np.ndarray]]:
        """Nodes 0 .. ``nodes`` - 1 after a batch optimisation: pose and position covariance (3x3, world).

        Empty when the system is indeterminate: what was said in flight stands."""
        self.leave(range(nodes))
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(30)
        params.setLinearSolverType("MULTIFRONTAL_QR")
        try:
            values = gtsam.LevenbergMarquardtOptimizer(self._factors, self.values, params).optimize()
            marginals = gtsam.Marginals(self._factors, values)
        except RuntimeError:  # how GTSAM says that a system is indeterminate
            return {}
        refined = {}
        for node in range(nodes):
            pose = values.atPose3(C(node))
            r = pose.rotation().matrix()
            refined[node] = (pose, r @ marginals.marginalCovariance(C(node))[3:, 3:] @ r.T)
        return refined

    def _without_python(self, factor: gtsam.NonlinearFactor) -> gtsam.NonlinearFactor:
        if not isinstance(factor, gtsam.CustomFactor):
            return factor
        around = gtsam.Values()
        for key in factor.keys():  # noqa: SIM118
            is_pose = gtsam.symbolChr(key) == gtsam.symbolChr(C(0))
            around.insert(key, self.values.atPose3(key) if is_pose else self.values.atVector(key))
        return gtsam.LinearContainerFactor(factor.linearize(around), around)
