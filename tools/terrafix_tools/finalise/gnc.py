"""Which measurements to believe: graduated non-convexity with a truncated least squares loss, over one GTSAM graph.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception (RA-L 2020). At first every
measurement counts nearly in full; from step to step the loss gets flatter, until each is either believed or not.
GTSAM's own GncOptimizer solves to the end at every step; here a step is one Gauss-Newton step."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

FLATTER = (
    2.5  # growth of mu from one step to the next; with 1.4 of the paper it takes three times the steps to the same end
)
FLAT = 8.0  # mu at which what is still between believed and not lies within an eighth of the limit
MOST_STEPS = 60
LAST_STEPS = 8
DONE_M = 1e-3  # largest part of a step that moves nothing any more, metres and radians
BELIEVED = 0.5

Covariances = gtsam.Marginals | gtsam.GaussianBayesTree


@dataclass(frozen=True)
class OutlierCandidate:
    """A measurement that may be wrong: its factor, ``weighted`` the same with its information times a weight, and the
    squared Mahalanobis distance from which on it is an outlier."""

    factor: gtsam.NonlinearFactor
    weighted: Callable[[float], gtsam.NonlinearFactor]
    limit: float


def solve(
    certain: gtsam.NonlinearFactorGraph, doubtful: list[OutlierCandidate], values: gtsam.Values
) -> tuple[gtsam.Values, np.ndarray]:
    """-> estimate, and which of ``doubtful`` are believed (bool). RuntimeError when the system is indeterminate."""
    limits = np.array([d.limit for d in doubtful])
    weights = np.ones(len(doubtful))
    squares = _squares(doubtful, values)
    worst = float(np.max(squares / limits, initial=0.0))
    if worst > 1.0:
        mu = 1.0 / (2.0 * worst - 1.0)
        for _ in range(MOST_STEPS):
            values, _ = _step(weighted(certain, doubtful, weights), values)
            weights = _weights(_squares(doubtful, values), limits, mu)
            if mu > FLAT:
                break
            mu *= FLATTER
    believed = weights > BELIEVED
    return settle(certain, doubtful, believed, values), believed


def settle(
    certain: gtsam.NonlinearFactorGraph, doubtful: list[OutlierCandidate], believed: np.ndarray, values: gtsam.Values
) -> gtsam.Values:
    """Gauss-Newton over what is believed, to its end."""
    graph = weighted(certain, doubtful, believed.astype(float))
    for _ in range(LAST_STEPS):
        values, moved = _step(graph, values)
        if moved < DONE_M:
            break
    return values


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Covariances:
    """To be asked for covariances. RuntimeError when the system is indeterminate."""
    try:
        return gtsam.Marginals(graph, values)
    except RuntimeError:  # as in a step
        return graph.linearize(values).eliminateMultifrontal(function=gtsam.EliminateQR)


def weighted(
    certain: gtsam.NonlinearFactorGraph, doubtful: list[OutlierCandidate], weights: np.ndarray
) -> gtsam.NonlinearFactorGraph:
    """One graph of both; ``weights`` 0 to 1."""
    graph = gtsam.NonlinearFactorGraph(certain)
    for measurement, weight in zip(doubtful, weights, strict=True):
        if weight >= 1.0:
            graph.push_back(measurement.factor)
        elif weight > 0.0:
            graph.push_back(measurement.weighted(float(weight)))
    return graph


def _step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[gtsam.Values, float]:
    linear = graph.linearize(values)
    try:
        delta = linear.optimize()
    except RuntimeError:  # Cholesky gives up on what hardly anything holds; QR takes three times as long
        delta = linear.optimize(gtsam.EliminateQR)
    return values.retract(delta), float(delta.norm()) / max(1.0, float(np.sqrt(values.size())))


def _squares(doubtful: list[OutlierCandidate], values: gtsam.Values) -> np.ndarray:
    return np.array([2.0 * d.factor.error(values) for d in doubtful])


def _weights(squares: np.ndarray, limits: np.ndarray, mu: float) -> np.ndarray:
    """Equation (14) of the paper."""
    between = np.sqrt(limits * mu * (mu + 1.0) / np.maximum(squares, 1e-12)) - mu
    return np.clip(between, 0.0, 1.0)
