"""Linear Gaussian elimination of graph nodes by QR.

The tangent of a node is NODE_SIZE numbers: C (rotation, translation in the axes of the camera), B and V
(terrafix.estimator.state)."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE, POSE_SIZE, NodeState

NODE_SIZE = POSE_SIZE + CALIBRATION_SIZE + MOTION_SIZE  # [spec: order C, B, V]
# Variable, first component and size of each block of a node. [spec: order C, B, V]
_BLOCKS = ((C, 0, POSE_SIZE), (B, POSE_SIZE, CALIBRATION_SIZE), (V, POSE_SIZE + CALIBRATION_SIZE, MOTION_SIZE))
# Least diagonal of the root information, per metre and radian: below it a node is indeterminate. [tuned]
MIN_ROOT = 1e-9


class IndeterminateError(Exception):
    """The factors do not determine a node, or are not finite."""


@dataclass(frozen=True)
class GaussianFactor:
    """|a x - b|^2, whitened, over the changes x of ``nodes``: ``a`` (m, NODE_SIZE * len(nodes)), ``b`` (m,)."""

    nodes: tuple[int, ...]
    a: np.ndarray
    b: np.ndarray

    def relinearized(self, node: int, change: np.ndarray) -> "GaussianFactor":
        """The same factor around a state of ``node`` that is ``change`` (NODE_SIZE,) from its linearization point."""
        if node not in self.nodes:
            return self
        first = NODE_SIZE * self.nodes.index(node)
        return GaussianFactor(self.nodes, self.a, self.b - self.a[:, first : first + NODE_SIZE] @ change)


@dataclass(frozen=True)
class Conditional:
    """Conditional of the changes x of ``nodes`` given the changes g of ``parents``: r x = d - s g + unit noise, with
    ``r`` upper triangular. Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017, 3.3."""

    nodes: tuple[int, ...]
    parents: tuple[int, ...]
    r: np.ndarray
    s: np.ndarray
    d: np.ndarray


def graph_of(factors: Iterable[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def values_of(states: Mapping[int, NodeState]) -> gtsam.Values:
    """Of C, B and V of each node."""
    values = gtsam.Values()
    for node, state in states.items():
        values.insert(C(node), state.pose)
        values.insert(B(node), state.calibration)
        values.insert(V(node), state.motion)
    return values


def nodes_of(factor: gtsam.NonlinearFactor) -> tuple[int, ...]:
    """The nodes of its variables, sorted."""
    return tuple(sorted({gtsam.symbolIndex(key) for key in factor.keys()}))  # noqa: SIM118 (a factor is no dict)


def linearize(factors: gtsam.NonlinearFactorGraph, nodes: list[int], around: gtsam.Values) -> GaussianFactor:
    """All factors, which involve no nodes but ``nodes``, as one. Robust factors get their weight at ``around``."""
    keys = factors.keyVector()
    ordering, columns = gtsam.Ordering(), list[int]()
    for i, node in enumerate(nodes):
        for variable, first, size in _BLOCKS:
            if (key := variable(node)) in keys:
                ordering.push_back(key)
                columns += range(NODE_SIZE * i + first, NODE_SIZE * i + first + size)
    jacobian, b = factors.linearize(around).jacobian(ordering)
    a = np.zeros((len(b), NODE_SIZE * len(nodes)))
    a[:, columns] = jacobian
    return GaussianFactor(tuple(nodes), a, b)


def eliminate(factors: list[GaussianFactor], frontals: list[int]) -> tuple[Conditional, GaussianFactor]:
    """``factors``: all that involve ``frontals``. -> the conditional of ``frontals`` given the other nodes, and the
    factor on the other nodes. Raises IndeterminateError."""
    parents = sorted({node for factor in factors for node in factor.nodes} - set(frontals))
    column = {node: NODE_SIZE * i for i, node in enumerate((*frontals, *parents))}
    size, width = NODE_SIZE * len(frontals), NODE_SIZE * len(column)
    full = np.zeros((max(sum(len(f.b) for f in factors), width), width + 1))
    row = 0
    for factor in factors:
        end = row + len(factor.b)
        for i, node in enumerate(factor.nodes):
            full[row:end, column[node] : column[node] + NODE_SIZE] = factor.a[:, NODE_SIZE * i : NODE_SIZE * (i + 1)]
        full[row:end, -1] = factor.b
        row = end
    r = np.asarray(np.linalg.qr(full, mode="r"))
    root = r[:size, :size]
    if not (np.isfinite(r).all() and np.abs(root.diagonal()).min() > MIN_ROOT):
        raise IndeterminateError
    conditional = Conditional(tuple(frontals), tuple(parents), root, r[:size, size:-1], r[:size, -1])
    # Copies: a view would hold all of ``r``, which is a hundred times as large, as long as the factor is kept.
    return conditional, GaussianFactor(tuple(parents), r[size:width, size:-1].copy(), r[size:width, -1].copy())


@dataclass(frozen=True)
class GaussianMarginal:
    """Joint marginal of the changes of ``nodes``: mean (NODE_SIZE * n,) and covariance."""

    nodes: tuple[int, ...]
    mean: np.ndarray
    cov: np.ndarray

    def marginal(self, nodes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """-> mean and covariance of some of the nodes, in this order."""
        at = np.concatenate([np.arange(NODE_SIZE) + NODE_SIZE * self.nodes.index(n) for n in nodes])
        return self.mean[at], self.cov[np.ix_(at, at)]


def solve(factors: list[GaussianFactor]) -> dict[int, GaussianMarginal]:
    """Solves for all nodes. -> for each node the joint marginal of it and its parents.

    Nodes are eliminated newest first, because factors reach back and many may involve one old node. Back substitution
    is oldest first: the joint marginal of a node's parents is known, because the newest parent depends on the others.
    Raises IndeterminateError."""
    by_newest: dict[int, list[GaussianFactor]] = {}  # factors by their newest node
    for factor in factors:
        by_newest.setdefault(factor.nodes[-1], []).append(factor)
    conditionals: list[Conditional] = []
    for node in sorted({node for factor in factors for node in factor.nodes}, reverse=True):
        conditional, remaining = eliminate(by_newest.pop(node, []), [node])
        conditionals.append(conditional)
        if remaining.nodes:
            by_newest.setdefault(remaining.nodes[-1], []).append(remaining)
    marginals: dict[int, GaussianMarginal] = {}
    for conditional in reversed(conditionals):
        parents = conditional.parents
        mean, cov = marginals[parents[-1]].marginal(parents) if parents else (np.zeros(0), np.zeros((0, 0)))
        inverse = np.linalg.inv(conditional.r)
        by_parents = -inverse @ conditional.s
        cross = by_parents @ cov
        own = inverse @ inverse.T + cross @ by_parents.T
        marginals[conditional.nodes[0]] = GaussianMarginal(
            (*conditional.nodes, *parents),
            np.concatenate([inverse @ conditional.d + by_parents @ mean, mean]),
            np.block([[own, cross], [cross.T, cov]]),
        )
    return marginals
