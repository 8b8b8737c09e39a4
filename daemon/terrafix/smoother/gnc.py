"""Inlier selection by graduated non-convexity with a truncated least squares loss, over one GTSAM graph.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception (RA-L 2020). At first every
measurement has nearly full weight. From step to step the loss becomes flatter, until each is an inlier or an outlier.
GTSAM's own GncOptimizer solves to convergence at every step; here a step is one Gauss-Newton step."""

from collections.abc import Callable
from dataclasses import dataclass

import gtsam
import numpy as np

MU_GROWTH = 2.5  # of mu per step; the paper's 1.4 takes three times the steps to the same result
MAX_MU = 8.0  # at which squares with a weight between 0 and 1 lie within an eighth of the limit
MAX_GNC_STEPS = 60
MAX_FINAL_STEPS = 8
GNC_STEP_TOLERANCE = 1e-3  # root mean square of a converged step, metres and radians
INLIER_WEIGHT = 0.5

Covariances = gtsam.Marginals | gtsam.GaussianBayesTree


@dataclass(frozen=True)
class OutlierCandidate:
    """A measurement that may be an outlier: its factor; ``weighted``, the factor with its information times a weight;
    and the squared Mahalanobis distance above which it is an outlier."""

    factor: gtsam.NonlinearFactor
    weighted: Callable[[float], gtsam.NonlinearFactor]
    limit: float


def solve(
    certain: gtsam.NonlinearFactorGraph, candidates: list[OutlierCandidate], values: gtsam.Values
) -> tuple[gtsam.Values, np.ndarray]:
    """-> estimate, and which ``candidates`` are inliers (bool). RuntimeError for an indeterminate system."""
    limits = np.array([d.limit for d in candidates])
    weights = np.ones(len(candidates))
    squares = _squares(candidates, values)
    worst = float(np.max(squares / limits, initial=0.0))
    if worst > 1.0:
        mu = 1.0 / (2.0 * worst - 1.0)
        for _ in range(MAX_GNC_STEPS):
            values, _ = _step(weighted(certain, candidates, weights), values)
            weights = truncated_weights(_squares(candidates, values), limits, mu)
            if mu > MAX_MU:
                break
            mu *= MU_GROWTH
    inliers = weights > INLIER_WEIGHT
    return settle(certain, candidates, inliers, values), inliers


def settle(
    certain: gtsam.NonlinearFactorGraph, candidates: list[OutlierCandidate], inliers: np.ndarray, values: gtsam.Values
) -> gtsam.Values:
    """Gauss-Newton over ``certain`` and the inliers, to convergence."""
    graph = weighted(certain, candidates, inliers.astype(float))
    for _ in range(MAX_FINAL_STEPS):
        values, moved = _step(graph, values)
        if moved < GNC_STEP_TOLERANCE:
            break
    return values


def marginals(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Covariances:
    """Marginal covariances. RuntimeError for an indeterminate system."""
    try:
        return gtsam.Marginals(graph, values)
    except RuntimeError:  # Cholesky fails, as in _step
        return graph.linearize(values).eliminateMultifrontal(function=gtsam.EliminateQR)


def weighted(
    certain: gtsam.NonlinearFactorGraph, candidates: list[OutlierCandidate], weights: np.ndarray
) -> gtsam.NonlinearFactorGraph:
    """One graph of ``certain`` and the candidates with ``weights`` from 0 to 1."""
    graph = gtsam.NonlinearFactorGraph(certain)
    for measurement, weight in zip(candidates, weights, strict=True):
        if weight >= 1.0:
            graph.push_back(measurement.factor)
        elif weight > 0.0:
            graph.push_back(measurement.weighted(float(weight)))
    return graph


def step_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> gtsam.VectorValues:
    """One step of Gauss-Newton from ``values``. RuntimeError for an indeterminate system."""
    linear = graph.linearize(values)
    try:
        return linear.optimize()
    except RuntimeError:  # Cholesky fails on a badly conditioned system; QR takes three times as long
        return linear.optimize(gtsam.EliminateQR)


def _step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> tuple[gtsam.Values, float]:
    delta = step_of(graph, values)
    return values.retract(delta), float(delta.norm()) / max(1.0, float(np.sqrt(values.size())))


def _squares(candidates: list[OutlierCandidate], values: gtsam.Values) -> np.ndarray:
    return np.array([2.0 * d.factor.error(values) for d in candidates])


def truncated_weights(squares: np.ndarray, limits: np.ndarray, mu: float) -> np.ndarray:
    """Equation (14) of the paper."""
    between = np.sqrt(limits * mu * (mu + 1.0) / np.maximum(squares, 1e-12)) - mu
    return np.clip(between, 0.0, 1.0)
