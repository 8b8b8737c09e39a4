"""Marginalisation of leaves: GTSAM loses a variable without a factor to the variables above it in the tree."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.graph.fixed_lag import BATCH_NODES, FixedLagSmoother
from terrafix.estimator.graph.pose_graph import GraphPrior, PoseGraph, _empty_factor
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE, NodeState

SIZES = {"c": 6, "b": CALIBRATION_SIZE, "v": MOTION_SIZE}
ALONE = BATCH_NODES - 1  # first node of a graph that is the last of a batch: it leaves alone


def of(keys: list[int], rng: np.random.Generator) -> gtsam.CustomFactor:
    """A random linear factor of these variables."""
    sizes = [SIZES[chr(gtsam.symbolChr(key))] for key in keys]
    by = [np.asfortranarray(rng.normal(0.0, 1.0, (8, size))) for size in sizes]

    def error(_this: object, _values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            for i, jacobian in enumerate(by):
                jacobians[i] = jacobian
        return np.zeros(8)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(8), keys, error)


def is_lost(seed: int, *, tied: bool) -> bool:
    """Whether the tree loses a variable within thirty nodes of a chain."""
    rng, lag, keyframe = np.random.default_rng(seed), FixedLagSmoother(), ALONE
    for n in range(ALONE, ALONE + 30):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(C(n), gtsam.Pose3())
        values.insert(B(n), np.zeros(CALIBRATION_SIZE))
        values.insert(V(n), np.zeros(MOTION_SIZE))
        if n == ALONE:
            for key in (C(n), B(n), V(n)):
                factors.add(of([key], rng))
            if tied:
                factors.add(_empty_factor(n))
        else:
            for keys in ([C(n - 1), V(n - 1), C(n), V(n), B(n)], [B(n - 1), B(n)], [C(keyframe), C(n), B(n)]):
                factors.add(of(keys, rng))
            keyframe = n if rng.random() < 0.5 else keyframe
        try:
            lag.insert(n, factors, values)
            if rng.random() < 0.8:
                fix = gtsam.NonlinearFactorGraph()
                fix.add(of([C(n)], rng))
                lag.add(fix)
        except (ValueError, IndexError):
            return True
    return False


def test_the_first_node_of_a_graph_is_marginalised_with_the_empty_factor_and_lost_without_it() -> None:
    assert not any(is_lost(seed, tied=True) for seed in range(24))
    assert any(is_lost(seed, tied=False) for seed in range(24)), (
        "GTSAM has fixed it: the empty factor is no longer needed"
    )


def test_the_first_node_of_every_graph_has_a_factor_of_c_and_b() -> None:
    graph = PoseGraph()
    state = NodeState(gtsam.Pose3(), np.zeros(CALIBRATION_SIZE), np.zeros(MOTION_SIZE))
    node = graph.start(0.0, GraphPrior(state, np.eye(6), np.eye(CALIBRATION_SIZE), np.eye(MOTION_SIZE)))
    window = [set(factor.keys()) for factor, _ in graph._history._window]
    assert any({C(node), B(node)} <= keys for keys in window)
    assert np.allclose(graph.covariance(node), np.eye(6)) and np.allclose(
        graph.calibration_covariance(node), np.eye(CALIBRATION_SIZE)
    )
