"""Covariances of nodes propagated from frame to frame, without the smoother's marginals (ON-2).

Each node has one parent: the keyframe of its odometry, or the node before it. So the nodes form a tree, on which an
update is exact: a measurement at one node changes the covariance of all nodes that are joined to it. The factors are
those that the graph gets. It leaves out what ties a node to more than its parent (three-view factors, the motion model
of frames with odometry), so that it claims no more than the graph knows."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from terrafix.estimator.graph.elimination import NODE_SIZE, eliminate, graph_of, linearize, values_of
from terrafix.estimator.state import CALIBRATION_SIZE, POSE_SIZE, NodeState

# Blocks of the covariance of a node. [spec: order C, B, V]
POSE, CALIBRATION = slice(0, POSE_SIZE), slice(POSE_SIZE, POSE_SIZE + CALIBRATION_SIZE)
MOTION = slice(POSE_SIZE + CALIBRATION_SIZE, NODE_SIZE)


@dataclass(frozen=True)
class _Edge:
    """Changes of a node given those of its ``parent``: ``by_parent`` (NODE_SIZE, NODE_SIZE) times these, plus noise."""

    parent: int
    by_parent: np.ndarray


class PropagatedCovariance:
    """Covariances (NODE_SIZE, NODE_SIZE) in the order of `elimination`: C, B, V."""

    def __init__(self) -> None:
        self._cov: dict[int, np.ndarray] = {}
        self._edges: dict[int, _Edge] = {}  # of each node with a parent in the window

    def __getitem__(self, node: int) -> np.ndarray:
        return self._cov[node]

    def begin(self, node: int, cov: np.ndarray) -> None:
        """``node`` has covariance ``cov`` and no parent."""
        self._cov[node] = cov
        self._edges.pop(node, None)

    def extend(
        self, node: int, parent: int, factors: Iterable[gtsam.NonlinearFactor], states: Mapping[int, NodeState]
    ) -> None:
        """A new ``node``. ``factors``: of it and ``parent``; they determine it. ``states``: estimates of both.

        What the factors tell of the parent (its attitude, seen from the new node) improves the parent, and of its other
        relatives none: they may become parents only by a reference to an older keyframe."""
        joint = linearize(graph_of(factors), [node, parent], values_of(states))
        conditional, of_parent = eliminate([joint], [node])
        self._cov[parent] = _updated(self._cov[parent], of_parent.a)
        inverse = np.linalg.inv(conditional.r)
        by_parent = -inverse @ conditional.s
        self._cov[node] = by_parent @ self._cov[parent] @ by_parent.T + inverse @ inverse.T
        self._edges[node] = _Edge(parent, by_parent)

    def fuse(self, node: int, factors: Iterable[gtsam.NonlinearFactor], state: NodeState) -> None:
        """Kalman update of ``node`` and its relatives. ``factors``: of the variables of ``node``, whose estimate is
        ``state``."""
        measured = linearize(graph_of(factors), [node], values_of({node: state}))
        before = self._cov[node]
        self._cov[node] = _updated(before, measured.a)
        self._pass_on(node, before, None)

    def retain(self, nodes: tuple[int, ...]) -> None:
        """Drops all nodes but ``nodes``."""
        self._cov = {node: cov for node, cov in self._cov.items() if node in nodes}
        self._edges = {n: edge for n, edge in self._edges.items() if n in self._cov and edge.parent in self._cov}

    def _pass_on(self, node: int, before: np.ndarray, source: int | None) -> None:
        """The covariance of ``node`` was ``before``: updates its neighbours but ``source``, and theirs. A neighbour x
        is J times the node plus what the measurement tells nothing about (Rauch, Tung and Striebel 1965)."""
        change = before - self._cov[node]
        for neighbour, gain in self._gains(node, before).items():
            if neighbour != source:
                neighbour_before = self._cov[neighbour]
                self._cov[neighbour] = _symmetric(neighbour_before - gain @ change @ gain.T)
                self._pass_on(neighbour, neighbour_before, node)

    def _gains(self, node: int, before: np.ndarray) -> dict[int, np.ndarray]:
        """Neighbour -> its regression (NODE_SIZE, NODE_SIZE) on ``node``, whose covariance was ``before``."""
        gains = {n: edge.by_parent for n, edge in self._edges.items() if edge.parent == node}
        if edge := self._edges.get(node):
            gains[edge.parent] = np.linalg.solve(before, edge.by_parent @ self._cov[edge.parent]).T
        return gains


def _updated(cov: np.ndarray, a: np.ndarray) -> np.ndarray:
    """``cov`` (n, n) after a measurement with Jacobian ``a`` (m, n) and unit noise."""
    cross = cov @ a.T
    return _symmetric(cov - cross @ np.linalg.solve(a @ cross + np.eye(len(a)), cross.T))


def _symmetric(cov: np.ndarray) -> np.ndarray:
    return np.asarray(0.5 * (cov + cov.T))
