"""Nodes that leave the window: GTSAM forgets one that nothing ties to what is above it in the tree."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.graph.fixed_lag import BATCH_NODES, FixedLagSmoother
from terrafix.estimator.graph.pose_graph import NodeState, PoseGraph, _tie
from terrafix.estimator.models.motion_model import V_SIZE

SIZES = {"c": 6, "b": BIAS_SIZE, "v": V_SIZE}
ALONE = BATCH_NODES - 1  # a graph that begins with the last node of a batch: that leaves by itself


def of(keys: list[int], rng: np.random.Generator) -> gtsam.CustomFactor:
    """Any linear factor of these."""
    sizes = [SIZES[chr(gtsam.symbolChr(key))] for key in keys]
    by = [np.asfortranarray(rng.normal(0.0, 1.0, (8, size))) for size in sizes]

    def error(_this: object, _values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            for i, jacobian in enumerate(by):
                jacobians[i] = jacobian
        return np.zeros(8)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(8), keys, error)


def is_lost(seed: int, *, tied: bool) -> bool:
    """Whether the tree loses a variable, in thirty nodes as they follow from each other."""
    rng, lag, keyframe = np.random.default_rng(seed), FixedLagSmoother(), ALONE
    for n in range(ALONE, ALONE + 30):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(C(n), gtsam.Pose3())
        values.insert(B(n), np.zeros(BIAS_SIZE))
        values.insert(V(n), np.zeros(V_SIZE))
        if n == ALONE:
            for key in (C(n), B(n), V(n)):
                factors.add(of([key], rng))
            if tied:
                factors.add(_tie(n))
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


def test_a_node_that_begins_a_graph_is_not_lost_when_it_leaves() -> None:
    assert not any(is_lost(seed, tied=True) for seed in range(24))
    assert any(is_lost(seed, tied=False) for seed in range(24)), "GTSAM has mended it: the tie is of no use any more"


def test_every_graph_begins_tied() -> None:
    graph = PoseGraph()
    state = NodeState(gtsam.Pose3(), np.zeros(BIAS_SIZE), np.zeros(V_SIZE))
    node = graph.start(0.0, state, np.eye(6), np.eye(BIAS_SIZE), np.eye(V_SIZE))
    window = [set(factor.keys()) for factor, _ in graph._past._window]
    assert any({C(node), B(node)} <= keys for keys in window)
    assert np.allclose(graph.covariance(node), np.eye(6)) and np.allclose(
        graph.bias_covariance(node), np.eye(BIAS_SIZE)
    )
