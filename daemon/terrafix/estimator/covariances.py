"""Covariances of the nodes in the window: the smoother's marginals, or, while the computer is hot, propagated (ON-2).

Everything that uses a covariance in flight reads it here, so that no marginal is computed in the JACOBIAN mode.

Propagated ones leave out factors, so that they are wider, by up to 1.7 in sigma. Where marginals return, the claim
would step down by that; it shrinks by NARROWING a frame instead, and is never below the marginals (``widening``)."""

from collections.abc import Iterable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V

from terrafix.core.pose import tangent_to_world
from terrafix.estimator.graph.pose_graph import GraphPrior, NewNode, PoseGraph, rebuild_prior
from terrafix.estimator.graph.propagated_covariance import (
    CALIBRATION_BLOCK,
    MOTION_BLOCK,
    POSE_BLOCK,
    PropagatedCovariance,
)
from terrafix.estimator.state import CALIBRATION_SIZE, HORIZONTAL, NodeState
from terrafix.messages import CovarianceMode

# Of the widening, per frame: half of the step of 10 % that a switch may cause. [measured: docs/jetson.md]
NARROWING = 0.05


class Covariances:
    """Of the nodes of ``graph``. Its owner reports every change of the graph, after it. ``widening``: at least 1,
    factor on the sigma of the newest node for its claim, after marginals have returned."""

    def __init__(self, graph: PoseGraph) -> None:
        self._graph = graph
        self._rebuilds = 0  # of the graph
        self._propagated: PropagatedCovariance | None = None  # None: marginals
        self._recorded: dict[int, np.ndarray] = {}  # node -> marginal of C (6, 6), of ``record``
        self.widening = 1.0

    @property
    def mode(self) -> CovarianceMode:
        return CovarianceMode.MARGINALS if self._propagated is None else CovarianceMode.JACOBIAN

    def set_mode(self, mode: CovarianceMode) -> None:
        """Propagation begins with the marginals of the nodes in the window, the last ones that are computed."""
        if mode is self.mode:
            return
        if self._propagated is not None:
            self._recorded = {node: self.pose(node) for node in self._graph.window}
            if not self._graph.window:  # nothing was claimed yet
                self._propagated = None
                return
            newest = self._graph.newest
            propagated, self._propagated = self._horizontal_sigma_m(newest), None
            # A widening that is left from the switch before is in the last claim.
            self.widening = max(1.0, self.widening * propagated / self._horizontal_sigma_m(newest))
            return
        self._propagated, self._rebuilds = PropagatedCovariance(), self._graph.rebuilds
        for node in self._graph.window:
            self._propagated.begin(node, self._graph.joint_covariance(node))

    def pose(self, node: int) -> np.ndarray:
        """(6, 6) of C, tangent order."""
        if self._propagated is not None:
            return self._propagated[node][POSE_BLOCK, POSE_BLOCK].copy()
        return self._graph.covariance(node)

    def record(self, node: int) -> None:
        """``recorded_pose`` of ``node`` is the present one: it was added, or a map match of its frame is evaluated."""
        if self._propagated is None:
            self._recorded[node] = self._graph.covariance(node)

    def _horizontal_sigma_m(self, node: int) -> float:
        """1-sigma along the worst horizontal axis."""
        cov = tangent_to_world(self.pose(node), self._graph.state(node).pose.rotation().matrix())
        return float(np.sqrt(np.linalg.eigvalsh(cov[HORIZONTAL, HORIZONTAL])[-1]))

    def recorded_pose(self, node: int) -> np.ndarray:
        """(6, 6) of C, tangent order, at the newest ``record``: no marginal is computed."""
        return self._recorded[node] if self._propagated is None else self.pose(node)

    def motion(self, node: int) -> np.ndarray:
        """(8, 8) of V."""
        if self._propagated is not None:
            return self._propagated[node][MOTION_BLOCK, MOTION_BLOCK].copy()
        return self._graph.motion_covariance(node)

    def calibration(self, node: int) -> np.ndarray:
        """(6, 6) of B."""
        if self._propagated is not None:
            return self._propagated[node][CALIBRATION_BLOCK, CALIBRATION_BLOCK].copy()
        return self._graph.calibration_covariance(node)

    def started(self, node: int, prior: GraphPrior) -> None:
        """A new graph has begun with ``node``."""
        self.widening = 1.0
        if self._propagated is not None:
            self._propagated = PropagatedCovariance()
            self._propagated.begin(node, prior.node_covariance)
            self.measured(node, [] if prior.attitude is None else [prior.attitude])

    def extended(self, new: NewNode, parent: NodeState, walk_sigmas: np.ndarray, motion_cov: np.ndarray) -> None:
        """The newest node is ``new``. ``parent``: of its parent, before; ``walk_sigmas`` (6,): 1-sigma of the change
        of B since; ``motion_cov`` (8, 8): of V, where the motion was seen."""
        window = self._graph.window
        self.widening = max(1.0, (1.0 - NARROWING) * self.widening)
        if self._propagated is None:
            self._recorded = {node: cov for node, cov in self._recorded.items() if node in window}
            return
        if self._restarted():
            return
        node, ties = self._graph.newest, self._graph.ties
        assert ties is not None
        walk = gtsam.noiseModel.Diagonal.Sigmas(walk_sigmas)
        factors = [ties.odometry, gtsam.BetweenFactorVector(B(new.parent), B(node), np.zeros(CALIBRATION_SIZE), walk)]
        by_increment = new.increment is not None and new.motion.rays is None  # the parent is the node before
        if by_increment or new.motion_cov is not None:
            factors.append(ties.motion)
        else:
            known = gtsam.noiseModel.Gaussian.Covariance(motion_cov)
            factors.append(gtsam.PriorFactorVector(V(node), new.state.motion, known))
        factors += [] if new.attitude is None else [new.attitude]
        # At the graph's linearization, whose robust weights are those of the estimate: with a stale one it uses less.
        linear = parent if new.parent not in window else self._graph.linearization(new.parent)
        self._propagated.extend(node, new.parent, factors, {node: self._graph.linearization(node), new.parent: linear})
        self._propagated.retain(window)

    def measured(self, node: int, factors: Iterable[gtsam.NonlinearFactor]) -> None:
        """``factors`` of the variables of ``node`` were added."""
        if self._propagated is not None and not self._restarted():
            self._propagated.fuse(node, factors, self._graph.linearization(node))

    def _restarted(self) -> bool:
        """Whether the graph was built anew since the call before: then it knows the newest node as little as its
        prior says."""
        before, self._rebuilds = self._rebuilds, self._graph.rebuilds
        if self._rebuilds == before:
            return False
        node = self._graph.newest
        self._propagated = PropagatedCovariance()
        self._propagated.begin(node, rebuild_prior(self._graph.state(node)).node_covariance)
        return True
