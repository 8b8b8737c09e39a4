"""What is known of some nodes, linear and Gaussian: nodes are taken out of it, or all are solved, by QR.

The changes x of a node are NODE numbers: C (rotation, translation in the camera's axes), B and V
(custom_factors.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.models.motion_model import V_SIZE

NODE = 6 + BIAS_SIZE + V_SIZE
_PLACES = ((C, 0, 6), (B, 6, BIAS_SIZE), (V, 6 + BIAS_SIZE, V_SIZE))
LEAST_ROOT = 1e-9  # of the information, per metre and radian: below, nothing holds a node


class IndeterminateError(Exception):
    """These factors leave something of a node open, or are no numbers."""


@dataclass(frozen=True)
class GaussianFactor:
    """|by x - rhs|^2, in sigmas, of the changes x of ``nodes``: ``by`` (m, NODE * len(nodes)), ``rhs`` (m,)."""

    nodes: tuple[int, ...]
    by: np.ndarray
    rhs: np.ndarray

    def moved(self, node: int, change: np.ndarray) -> "GaussianFactor":
        """The same around another state of ``node``, which lies ``change`` (NODE,) from where it was linear."""
        if node not in self.nodes:
            return self
        first = NODE * self.nodes.index(node)
        return GaussianFactor(self.nodes, self.by, self.rhs - self.by[:, first : first + NODE] @ change)


@dataclass(frozen=True)
class Conditional:
    """Of ``nodes``, once the changes g of ``given`` are known: root x = rhs - by_given g + unit noise.

    ``root`` is upper triangular. Dellaert and Kaess, "Factor Graphs for Robot Perception", 2017, 3.3."""

    nodes: tuple[int, ...]
    given: tuple[int, ...]
    root: np.ndarray
    by_given: np.ndarray
    rhs: np.ndarray


def nodes_of(factor: gtsam.NonlinearFactor) -> tuple[int, ...]:
    return tuple(sorted({gtsam.symbolIndex(key) for key in factor.keys()}))  # noqa: SIM118 (a factor is no dict)


def linear_of(factors: gtsam.NonlinearFactorGraph, nodes: list[int], around: gtsam.Values) -> GaussianFactor:
    """All of them as one; they touch no other nodes. A robust factor gets the weight that it has there."""
    keys = factors.keyVector()
    ordering, columns = gtsam.Ordering(), list[int]()
    for i, node in enumerate(nodes):
        for variable, first, size in _PLACES:
            if (key := variable(node)) in keys:
                ordering.push_back(key)
                columns += range(NODE * i + first, NODE * i + first + size)
    a, rhs = factors.linearize(around).jacobian(ordering)
    by = np.zeros((len(rhs), NODE * len(nodes)))
    by[:, columns] = a
    return GaussianFactor(tuple(nodes), by, rhs)


def eliminate(factors: list[GaussianFactor], gone: list[int]) -> tuple[Conditional, GaussianFactor]:
    """``factors``: all that touch ``gone``. -> these given the other nodes, and what is known of the others without
    them. Raises IndeterminateError."""
    given = sorted({node for factor in factors for node in factor.nodes} - set(gone))
    column = {node: NODE * i for i, node in enumerate((*gone, *given))}
    size, width = NODE * len(gone), NODE * len(column)
    full = np.zeros((max(sum(len(f.rhs) for f in factors), width), width + 1))
    row = 0
    for factor in factors:
        below = row + len(factor.rhs)
        for i, node in enumerate(factor.nodes):
            full[row:below, column[node] : column[node] + NODE] = factor.by[:, NODE * i : NODE * (i + 1)]
        full[row:below, -1] = factor.rhs
        row = below
    r = np.asarray(np.linalg.qr(full, mode="r"))
    root = r[:size, :size]
    if not (np.isfinite(r).all() and np.abs(root.diagonal()).min() > LEAST_ROOT):
        raise IndeterminateError
    known = Conditional(tuple(gone), tuple(given), root, r[:size, size:-1], r[:size, -1])
    return known, GaussianFactor(tuple(given), r[size:width, size:-1], r[size:width, -1])


@dataclass(frozen=True)
class GaussianMarginal:
    """The changes of ``nodes`` together: mean (NODE * n,) and covariance."""

    nodes: tuple[int, ...]
    mean: np.ndarray
    cov: np.ndarray

    def of(self, nodes: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """The same of some of them, in this order."""
        at = np.concatenate([np.arange(NODE) + NODE * self.nodes.index(n) for n in nodes])
        return self.mean[at], self.cov[np.ix_(at, at)]


def solve(factors: list[GaussianFactor]) -> dict[int, GaussianMarginal]:
    """All nodes together. -> of each node what is known of it and of all older ones that share a factor with it.

    Nodes are taken out one by one, newest first, since factors reach back, and one old node may be where many hang.
    They come back oldest first, each with what it hangs on: that is known together, since the newest of it hangs on the
    rest. Raises IndeterminateError."""
    newest: dict[int, list[GaussianFactor]] = {}  # factors by their newest node
    for factor in factors:
        newest.setdefault(factor.nodes[-1], []).append(factor)
    conditionals: list[Conditional] = []
    for node in sorted({node for factor in factors for node in factor.nodes}, reverse=True):
        conditional, left = eliminate(newest.pop(node, []), [node])
        conditionals.append(conditional)
        if left.nodes:
            newest.setdefault(left.nodes[-1], []).append(left)
    known: dict[int, GaussianMarginal] = {}
    for conditional in reversed(conditionals):
        given = conditional.given
        mean, cov = known[given[-1]].of(given) if given else (np.zeros(0), np.zeros((0, 0)))
        inverse = np.linalg.inv(conditional.root)
        by = -inverse @ conditional.by_given
        across = by @ cov
        own = inverse @ inverse.T + across @ by.T
        known[conditional.nodes[0]] = GaussianMarginal(
            (*conditional.nodes, *given),
            np.concatenate([inverse @ conditional.rhs + by @ mean, mean]),
            np.block([[own, across], [across.T, cov]]),
        )
    return known
