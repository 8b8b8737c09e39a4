"""Pose graph: window, queries, and rebuild after a numerical failure."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V

from simulated_flight import EstimatorRun, Flight, cov_of, error_m, sigma_m, t_ns
from terrafix.core.limits import WINDOW_NODES
from terrafix.estimator.factors.noise import robust_noise
from terrafix.estimator.graph.fixed_lag import BATCH_NODES, FixedLagSmoother
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE
from terrafix.messages import MapMatch, Refinement, SourceEnded, Verdict


def graph_of(run: EstimatorRun) -> PoseGraph:
    estimator = run.node.estimator
    assert estimator is not None
    return estimator.graph


def test_the_window_contains_the_newest_nodes_of_one_lag_and_at_most_one_batch() -> None:
    run = EstimatorRun().fly(Flight(80, seed=3), 0, 80)
    graph = graph_of(run)
    held = [n for n in range(80) if graph.holds(n)]
    assert held == list(range(held[0], 80)) and WINDOW_NODES <= len(held) <= WINDOW_NODES + BATCH_NODES
    assert graph._smoother.estimate().size() == 3 * len(held)
    assert len(run.node.estimator.state.node_of) <= len(held)  # type: ignore[union-attr]


def test_queries_return_the_newest_update_and_copies_of_the_cache() -> None:
    """Results are cached until the next update; a caller cannot modify the cache."""
    flight = Flight(40, seed=3)
    run = EstimatorRun().fly(flight, 0, 38)
    graph = graph_of(run)
    before, cov = graph.state(37).pose.translation().copy(), graph.covariance(37)
    cov *= 0.0
    assert graph.covariance(37) == pytest.approx(graph._smoother.marginal(C(37)))
    run.feed([flight.fix(37)])
    assert not np.allclose(graph.state(37).pose.translation(), before)
    assert graph.covariance(37) == pytest.approx(graph._smoother.marginal(C(37)))


@pytest.mark.parametrize("seed", range(6))
def test_marginalisation_leaves_estimates_and_marginals_unchanged(seed: int) -> None:
    """Vectors with factors to the node before and to a keyframe, to a node that is retained for long, and with late
    factors, against a batch solution."""
    rng = np.random.default_rng([seed, 4])
    lag, batch = FixedLagSmoother(), gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    unit = gtsam.noiseModel.Unit.Create
    for i in range(90):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stands = 30 <= i < 65
        keyframe = 29 if stands else max(0, i - int(rng.integers(1, 5)))
        if stands:
            lag.keep(keyframe)
        for key, size in ((B, CALIBRATION_SIZE), (V, MOTION_SIZE)):
            values.insert(key(i), np.zeros(size))
            if i == 0 or rng.random() < 0.2:
                factors.add(gtsam.PriorFactorVector(key(i), rng.normal(size=size), unit(size)))
            for before in {keyframe, max(0, i - 1)} - {i}:
                factors.add(gtsam.BetweenFactorVector(key(before), key(i), rng.normal(size=size), unit(size)))
        values.insert(C(i), gtsam.Pose3())
        factors.add(gtsam.PriorFactorPose3(C(i), gtsam.Pose3(), unit(6)))
        lag.insert(i, factors, values)
        if i > WINDOW_NODES and rng.random() < 0.4:
            late = gtsam.NonlinearFactorGraph()
            node = i - int(rng.integers(0, WINDOW_NODES))
            late.add(gtsam.PriorFactorVector(V(node), rng.normal(size=MOTION_SIZE), unit(MOTION_SIZE)))
            if not stands or i < 30 + WINDOW_NODES:
                lag.add(late)
                factors.push_back(late)
        batch.push_back(factors)
        start.insert(values)
    exact = gtsam.LevenbergMarquardtOptimizer(batch, start).optimize()
    marginals = gtsam.Marginals(batch, exact)
    for key in [variable(n) for n in range(90 - WINDOW_NODES, 90) for variable in (B, V)]:
        assert lag.vector(key) == pytest.approx(exact.atVector(key), abs=1e-6)
        assert lag.marginal(key) == pytest.approx(marginals.marginalCovariance(key), rel=1e-6, abs=1e-9)


def test_a_factor_that_is_not_finite_rebuilds_the_graph_with_a_larger_covariance() -> None:
    flight = Flight(90, seed=6)
    run = EstimatorRun().fly(flight, 0, 45)
    graph, before = graph_of(run), sigma_m(run.estimate(44))
    graph.add(gtsam.PriorFactorPose3(C(44), gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan)), robust_noise(np.eye(6))))
    assert graph.rebuilds == 1 and graph.newest == 44
    run.feed([m for m in flight.messages(45) if not isinstance(m, MapMatch)])
    assert np.isfinite(run.estimate(45).cov).all() and sigma_m(run.estimate(45)) > 5.0 * before
    run.fly(flight, 46, 90)
    assert graph.rebuilds == 1
    assert run.verdicts("map")[54].verdict is Verdict.ACCEPTED
    error = error_m(run.estimate(89), flight)[:2]
    assert error @ np.linalg.solve(cov_of(run.estimate(89))[:2, :2], error) < 13.8  # chi-square, 99.9 %
    run.feed([SourceEnded(t_ns=t_ns(89), frames=90)])
    refined = [m for m in run.published if isinstance(m, Refinement)][-1]
    assert [p.frame_id for p in refined.poses] == list(range(90))


@pytest.mark.parametrize("error", [RuntimeError, OverflowError])
def test_a_frame_that_makes_the_graph_indeterminate_rebuilds_it_from_that_frame(
    monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    flight = Flight(60, seed=6)
    run = EstimatorRun().fly(flight, 0, 45)
    graph, before = graph_of(run), sigma_m(run.estimate(44))

    def indeterminate(*_: object) -> None:
        raise error

    monkeypatch.setattr(graph._smoother, "insert", indeterminate)  # the rebuild replaces this smoother
    run.feed([m for m in flight.messages(45) if not isinstance(m, MapMatch)])
    assert graph.rebuilds == 1 and graph.newest == 45
    assert sigma_m(run.estimate(45)) > 5.0 * before
    run.fly(flight, 46, 60)
    assert graph.rebuilds == 1
    off_m = error_m(run.estimate(59), flight)[:2]
    assert off_m @ np.linalg.solve(cov_of(run.estimate(59))[:2, :2], off_m) < 13.8  # chi-square, 99.9 %
