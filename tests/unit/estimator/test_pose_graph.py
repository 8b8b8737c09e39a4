"""The graph: its window, its queries, and what it does when the numbers break."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V

from simulated_flight import Flight, Listener, cov_of, error_m, sigma_m, t_ns
from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.graph.fixed_lag import BATCH_NODES, LAG_NODES, FixedLagSmoother
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.estimator.models.motion_model import V_SIZE
from terrafix.messages import MapMatch, Refinement, SourceEnded, Verdict


def graph_of(run: Listener) -> PoseGraph:
    estimator = run.node._estimator
    assert estimator is not None
    return estimator.graph


def test_the_window_holds_what_it_says_and_no_more() -> None:
    run = Listener().fly(Flight(80, seed=3), 0, 80)
    graph = graph_of(run)
    held = [n for n in range(80) if graph.holds(n)]
    assert held == list(range(held[0], 80)) and LAG_NODES <= len(held) <= LAG_NODES + BATCH_NODES
    assert graph._smoother.estimate().size() == 3 * len(held)
    assert len(run.node._estimator._node_of) <= len(held)  # type: ignore[union-attr]


def test_queries_are_of_the_newest_update() -> None:
    """They are kept until then, and nobody can change what is kept."""
    flight = Flight(40, seed=3)
    run = Listener().fly(flight, 0, 38)
    graph = graph_of(run)
    before, cov = graph.state(37).pose.translation().copy(), graph.covariance(37)
    cov *= 0.0
    assert graph.covariance(37) == pytest.approx(graph._smoother.marginal(C(37)))
    run.hear([flight.fix(37)])
    assert not np.allclose(graph.state(37).pose.translation(), before)
    assert graph.covariance(37) == pytest.approx(graph._smoother.marginal(C(37)))


@pytest.mark.parametrize("seed", range(6))
def test_marginalising_changes_no_estimate(seed: int) -> None:
    """Numbers that hang on the ones before and on those of a keyframe, on one that is held for long, and some of which
    are told late, against a solution of everything at once."""
    rng = np.random.default_rng([seed, 4])
    lag, everything = FixedLagSmoother(), gtsam.NonlinearFactorGraph()
    start = gtsam.Values()
    unit = gtsam.noiseModel.Unit.Create
    for i in range(90):
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stands = 30 <= i < 65
        keyframe = 29 if stands else max(0, i - int(rng.integers(1, 5)))
        if stands:
            lag.keep(keyframe)
        for key, size in ((B, BIAS_SIZE), (V, V_SIZE)):
            values.insert(key(i), np.zeros(size))
            if i == 0 or rng.random() < 0.2:
                factors.add(gtsam.PriorFactorVector(key(i), rng.normal(size=size), unit(size)))
            for before in {keyframe, max(0, i - 1)} - {i}:
                factors.add(gtsam.BetweenFactorVector(key(before), key(i), rng.normal(size=size), unit(size)))
        values.insert(C(i), gtsam.Pose3())
        factors.add(gtsam.PriorFactorPose3(C(i), gtsam.Pose3(), unit(6)))
        lag.insert(i, factors, values)
        if i > LAG_NODES and rng.random() < 0.4:
            late = gtsam.NonlinearFactorGraph()
            node = i - int(rng.integers(0, LAG_NODES))
            late.add(gtsam.PriorFactorVector(V(node), rng.normal(size=V_SIZE), unit(V_SIZE)))
            if not stands or i < 30 + LAG_NODES:
                lag.add(late)
                factors.push_back(late)
        everything.push_back(factors)
        start.insert(values)
    exact = gtsam.LevenbergMarquardtOptimizer(everything, start).optimize()
    marginals = gtsam.Marginals(everything, exact)
    for key in [variable(n) for n in range(90 - LAG_NODES, 90) for variable in (B, V)]:
        assert lag.vector(key) == pytest.approx(exact.atVector(key), abs=1e-6)
        assert lag.marginal(key) == pytest.approx(marginals.marginalCovariance(key), rel=1e-6, abs=1e-9)


def test_numbers_that_break_cost_confidence_and_nothing_else() -> None:
    flight = Flight(90, seed=6)
    run = Listener().fly(flight, 0, 45)
    graph, before = graph_of(run), sigma_m(run.estimate(44))
    graph.add_pose(44, gtsam.Pose3(gtsam.Rot3(), np.full(3, np.nan)), np.eye(6))
    assert graph.rebuilds == 1 and graph.newest == 44
    run.hear([m for m in flight.messages(45) if not isinstance(m, MapMatch)])
    assert np.isfinite(run.estimate(45).cov).all() and sigma_m(run.estimate(45)) > 5.0 * before
    run.fly(flight, 46, 90)
    assert graph.rebuilds == 1
    assert run.verdicts("map")[54].verdict is Verdict.ACCEPTED
    error = error_m(run.estimate(89), flight)[:2]
    assert error @ np.linalg.solve(cov_of(run.estimate(89))[:2, :2], error) < 13.8  # chi-square, 99.9 %
    run.hear([SourceEnded(t_ns=t_ns(89), frames=90)])
    refined = [m for m in run.said if isinstance(m, Refinement)][-1]
    assert [p.frame_id for p in refined.poses] == list(range(90))


@pytest.mark.parametrize("said", [RuntimeError, OverflowError])
def test_a_frame_that_breaks_the_graph_is_where_it_begins_anew(
    monkeypatch: pytest.MonkeyPatch, said: type[Exception]
) -> None:
    flight = Flight(60, seed=6)
    run = Listener().fly(flight, 0, 45)
    graph, before = graph_of(run), sigma_m(run.estimate(44))

    def indeterminate(*_: object) -> None:
        raise said

    monkeypatch.setattr(graph._smoother, "insert", indeterminate)  # which is thrown away with it
    run.hear([m for m in flight.messages(45) if not isinstance(m, MapMatch)])
    assert graph.rebuilds == 1 and graph.newest == 45
    assert sigma_m(run.estimate(45)) > 5.0 * before
    run.fly(flight, 46, 60)
    assert graph.rebuilds == 1
    error = error_m(run.estimate(59), flight)[:2]
    assert error @ np.linalg.solve(cov_of(run.estimate(59))[:2, :2], error) < 13.8  # chi-square, 99.9 %
