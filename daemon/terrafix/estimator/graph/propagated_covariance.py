"""Covariances of nodes propagated from frame to frame, without the smoother's marginals (ON-2).

Each node has one parent: the keyframe of its odometry, or the node before it. So the nodes form a tree, on which an
update is exact: a measurement at one node changes the covariance of all nodes that are joined to it. The factors are
those that the graph gets. It leaves out what ties a node to more than its parent (three-view factors, the motion model
of frames with odometry), so that it claims no more than the graph knows."""

from collections.abc import Iterable, Mapping

import gtsam
import numpy as np

from terrafix.estimator.graph.elimination import NODE_SIZE, eliminate, graph_of, linearize, values_of
from terrafix.estimator.state import CALIBRATION_SIZE, POSE_SIZE, NodeState

# Blocks of the covariance of a node. [spec: order C, B, V]
POSE_BLOCK, CALIBRATION_BLOCK = slice(0, POSE_SIZE), slice(POSE_SIZE, POSE_SIZE + CALIBRATION_SIZE)
MOTION_BLOCK = slice(POSE_SIZE + CALIBRATION_SIZE, NODE_SIZE)


class PropagatedCovariance:
    """Covariances (NODE_SIZE, NODE_SIZE) in the order of `elimination`: C, B, V."""

    def __init__(self) -> None:
        self._cov: dict[int, np.ndarray] = {}
        # Of a node with each node that it is joined to (its parent and its children): rows of the former
        self._cross: dict[int, dict[int, np.ndarray]] = {}

    def __getitem__(self, node: int) -> np.ndarray:
        return self._cov[node]

    def begin(self, node: int, cov: np.ndarray) -> None:
        """A new ``node`` has covariance ``cov`` and no parent."""
        self._cov[node], self._cross[node] = cov, {}

    def extend(
        self, node: int, parent: int, factors: Iterable[gtsam.NonlinearFactor], states: Mapping[int, NodeState]
    ) -> None:
        """A new ``node``. ``factors``: of it and ``parent``; they determine it. ``states``: estimates of both.

        What the factors tell of the parent (its attitude, seen from the new node) is a measurement there."""
        joint = linearize(graph_of(factors), [node, parent], values_of(states))
        conditional, of_parent = eliminate([joint], [node])
        self._update(parent, of_parent.a)
        inverse = np.linalg.inv(conditional.r)
        by_parent = -inverse @ conditional.s
        cross = by_parent @ self._cov[parent]
        self.begin(node, _symmetric(cross @ by_parent.T + inverse @ inverse.T))
        self._join(node, parent, cross)

    def fuse(self, node: int, factors: Iterable[gtsam.NonlinearFactor], state: NodeState) -> None:
        """Kalman update of ``node`` and of all that it is joined to. ``factors``: of the variables of ``node``, whose
        estimate is ``state``."""
        self._update(node, linearize(graph_of(factors), [node], values_of({node: state})).a)

    def retain(self, nodes: tuple[int, ...]) -> None:
        """Drops all nodes but ``nodes``."""
        self._cov = {node: cov for node, cov in self._cov.items() if node in nodes}
        self._cross = {
            node: {other: cross for other, cross in self._cross[node].items() if other in self._cov}
            for node in self._cov
        }

    def _join(self, node: int, other: int, cross: np.ndarray) -> None:
        self._cross[node][other], self._cross[other][node] = cross, cross.T

    def _update(self, node: int, a: np.ndarray) -> None:
        """Measurement of ``node`` with Jacobian ``a`` (m, NODE_SIZE) and unit noise."""
        before = self._cov[node]
        cross = before @ a.T
        self._cov[node] = _symmetric(before - cross @ np.linalg.solve(a @ cross + np.eye(len(a)), cross.T))
        self._pass_on(node, before, source=None)

    def _pass_on(self, node: int, before: np.ndarray, source: int | None) -> None:
        """The covariance of ``node`` was ``before``: updates the nodes that it is joined to but ``source``, and theirs.
        Such a node is a gain times ``node`` plus what the measurement tells nothing about (Rauch, Tung, Striebel
        1965), so the gain stays as it was."""
        cov = self._cov[node]
        for other, cross in list(self._cross[node].items()):
            if other == source:
                continue
            gain, other_before = np.linalg.solve(before, cross).T, self._cov[other]
            self._cov[other] = _symmetric(other_before - gain @ (before - cov) @ gain.T)
            self._join(node, other, cov @ gain.T)
            self._pass_on(other, other_before, node)


def _symmetric(cov: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (cov + cov.T))
