"""Marginalised history of a flight: refinement against a batch solution, and bounded size."""

import gc
import tracemalloc

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V

from terrafix.core.pose import log_so3, tangent_to_world
from terrafix.estimator.graph import marginalized
from terrafix.estimator.graph.elimination import NODE_SIZE, GaussianFactor, IndeterminateError, eliminate, solve
from terrafix.estimator.graph.fixed_lag import FixedLagSmoother
from terrafix.estimator.graph.marginalized import MAX_UNSEPARATED, MarginalizedHistory
from terrafix.estimator.state import CALIBRATION_SIZE, MOTION_SIZE

STEP_M, TURN_RAD = np.array([6.0, 0.0, 0.0]), 0.02
ODOMETRY = np.array([0.003, 0.003, 0.006, 0.3, 0.3, 0.3])  # 1-sigma
FIX = np.array([0.02, 0.02, 0.02, 2.0, 2.0, 2.0])


def random_chain(nodes: int, rng: np.random.Generator) -> list[GaussianFactor]:
    """A prior, factors of neighbours, and one node with a factor to every third one."""
    sides = [(0,), *((i, i + 1) for i in range(nodes - 1)), *((2, i) for i in range(5, nodes, 3))]
    return [
        GaussianFactor(s, rng.normal(size=(NODE_SIZE, NODE_SIZE * len(s))), rng.normal(size=NODE_SIZE)) for s in sides
    ]


def dense(factors: list[GaussianFactor], nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Solution of the normal equations: changes (nodes, NODE_SIZE), covariance (both NODE_SIZE * nodes)."""
    information, vector = np.zeros((NODE_SIZE * nodes, NODE_SIZE * nodes)), np.zeros(NODE_SIZE * nodes)
    for f in factors:
        at = np.concatenate([np.arange(NODE_SIZE) + NODE_SIZE * n for n in f.nodes])
        information[np.ix_(at, at)] += f.a.T @ f.a
        vector[at] += f.a.T @ f.b
    cov = np.linalg.inv(information)
    return (cov @ vector).reshape(nodes, NODE_SIZE), cov


def test_elimination_node_by_node_gives_the_dense_solution() -> None:
    factors = random_chain(14, np.random.default_rng(1))
    mean, cov = dense(factors, 14)
    solved = solve(factors)
    assert sorted(solved) == list(range(14))
    for node, known in solved.items():
        change, its_cov = known.marginal([node])
        at = slice(NODE_SIZE * node, NODE_SIZE * (node + 1))
        assert change == pytest.approx(mean[node], rel=1e-6, abs=1e-8)
        assert its_cov == pytest.approx(cov[at, at], rel=1e-6, abs=1e-8)


def test_eliminating_nodes_leaves_the_other_marginals_unchanged() -> None:
    factors = random_chain(12, np.random.default_rng(2))
    before = solve(factors)
    for gone in ([6, 7], [4], [9, 10]):
        touching = [f for f in factors if set(gone) & set(f.nodes)]
        known, left = eliminate(touching, gone)
        factors = [f for f in factors if f not in touching] + [left]
        assert set(left.nodes) == set(known.parents) == {n for f in touching for n in f.nodes} - set(gone)
    after = solve(factors)
    assert sorted(after) == [0, 1, 2, 3, 5, 8, 11]
    for node, known in after.items():
        (change, cov), (change_before, cov_before) = known.marginal([node]), before[node].marginal([node])
        assert change == pytest.approx(change_before, rel=1e-6, abs=1e-8)
        assert cov == pytest.approx(cov_before, rel=1e-6, abs=1e-8)


def test_a_node_without_a_prior_and_nan_are_indeterminate() -> None:
    with pytest.raises(IndeterminateError):
        solve(random_chain(4, np.random.default_rng(3))[1:])  # without the prior
    with pytest.raises(IndeterminateError):
        solve([GaussianFactor((0,), np.full((NODE_SIZE, NODE_SIZE), np.nan), np.zeros(NODE_SIZE))])


class Chain:
    """Nodes that leave the window as in flight, and the same factors for a batch optimisation."""

    def __init__(self, nodes: int, *, fixes: set[int], keyframes: int = 3, seed: int = 0, stationary: range = range(0)):
        rng = np.random.default_rng([seed, 5])
        self.nodes, self.stationary = nodes, stationary
        self.factors: list[gtsam.NonlinearFactorGraph] = []
        self.steps: list[tuple[int, gtsam.Pose3]] = [(0, gtsam.Pose3())]  # parent, and the motion since by odometry
        self.left_with = gtsam.Values()  # estimates with which the nodes left
        poses = [gtsam.Pose3()]
        for i in range(nodes):
            graph = gtsam.NonlinearFactorGraph()
            if i == 0:
                graph.add(gtsam.PriorFactorPose3(C(0), poses[0], gtsam.noiseModel.Diagonal.Sigmas(FIX)))
            else:
                step = np.zeros(6) if i in stationary[1:] else np.array([0.0, 0.0, TURN_RAD, *STEP_M])
                poses.append(poses[-1].compose(gtsam.Pose3.Expmap(step)))
                parent = stationary.start if i in stationary[1:] else max(0, (i - 1) // keyframes * keyframes)
                noise = gtsam.Pose3.Expmap(ODOMETRY * rng.normal(size=6))
                self.steps.append((parent, poses[parent].between(poses[i]).compose(noise)))
                odometry = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY)
                graph.add(gtsam.BetweenFactorPose3(C(parent), C(i), self.steps[i][1], odometry))
                graph.add(
                    gtsam.BetweenFactorVector(
                        B(i - 1), B(i), np.zeros(CALIBRATION_SIZE), gtsam.noiseModel.Unit.Create(CALIBRATION_SIZE)
                    )
                )
                graph.add(
                    gtsam.BetweenFactorVector(
                        V(i - 1), V(i), np.zeros(MOTION_SIZE), gtsam.noiseModel.Unit.Create(MOTION_SIZE)
                    )
                )
            graph.add(
                gtsam.PriorFactorVector(
                    B(i), np.zeros(CALIBRATION_SIZE), gtsam.noiseModel.Unit.Create(CALIBRATION_SIZE)
                )
            )
            graph.add(gtsam.PriorFactorVector(V(i), np.zeros(MOTION_SIZE), gtsam.noiseModel.Unit.Create(MOTION_SIZE)))
            if i in fixes:
                fix = poses[i].compose(gtsam.Pose3.Expmap(FIX * rng.normal(size=6)))
                graph.add(gtsam.PriorFactorPose3(C(i), fix, gtsam.noiseModel.Diagonal.Sigmas(FIX)))
            self.factors.append(graph)

    def flown(self, past: MarginalizedHistory) -> MarginalizedHistory:
        """While the vehicle is stationary, the first node of that time is retained in the window."""
        past.begin_segment(0)
        lag, window = FixedLagSmoother(), list[int]()
        for i, (factors, (parent, motion)) in enumerate(zip(self.factors, self.steps, strict=True)):
            if i in self.stationary[1:]:
                lag.keep(self.stationary.start)
            leaving = lag.leaving(i)
            if leaving:
                past.marginalize(leaving, self._noted(lag, window))
            values = gtsam.Values()
            values.insert(C(i), lag.pose(parent).compose(motion) if i else motion)
            values.insert(B(i), np.zeros(CALIBRATION_SIZE))
            values.insert(V(i), np.zeros(MOTION_SIZE))
            lag.insert(i, factors, values)
            window = [n for n in window if n not in leaving] + [i]
            past.add(factors)
            past.reduce_step()
        past.marginalize(window, self._noted(lag, window))
        return past

    def _noted(self, lag: FixedLagSmoother, window: list[int]) -> gtsam.Values:
        values = lag.estimate()
        for n in window:
            for key in (C(n), B(n), V(n)):
                at = values.atPose3(key) if key == C(n) else values.atVector(key)
                self.left_with.insert_or_assign(key, at)
        return values

    def batch(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (N, 3), orientations (N, 3, 3) and covariances (N, 6, 6) by GTSAM, everything at once."""
        graph = gtsam.NonlinearFactorGraph()
        for factors in self.factors:
            graph.push_back(factors)
        values = gtsam.LevenbergMarquardtOptimizer(graph, self.left_with).optimize()
        marginals = gtsam.Marginals(graph, values)
        poses = [values.atPose3(C(i)) for i in range(self.nodes)]
        turns = [p.rotation().matrix() for p in poses]
        cov = [tangent_to_world(marginals.marginalCovariance(C(i)), r) for i, r in enumerate(turns)]
        return np.array([p.translation() for p in poses]), np.array(turns), np.array(cov)


def sigmas(cov: np.ndarray) -> np.ndarray:
    """(N, 6, 6) -> (N, 2) horizontal."""
    return np.asarray(np.sqrt(cov[:, [0, 1], [0, 1]]))


@pytest.mark.parametrize("max_retained", [256, 12])
def test_refinement_equals_the_batch_optimisation_of_the_whole_flight(
    max_retained: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A gap of 100 nodes without a fix, and 25 m to correct at its end. The rest is due to nonlinearity. The number of
    retained nodes makes no difference."""
    monkeypatch.setattr(marginalized, "MAX_RETAINED", max_retained)
    chain = Chain(260, fixes={*range(10, 100, 10), *range(200, 260, 10)})
    past = chain.flown(MarginalizedHistory())
    p_m, r_w_c, cov = past.refine()
    assert len(past._retained) <= max_retained + 1 and len(past._linear) <= max_retained + 1
    exact_m, exact_r, exact_cov = chain.batch()
    flown_m = np.array([chain.left_with.atPose3(C(i)).translation() for i in range(260)])
    assert np.linalg.norm(flown_m - exact_m, axis=1).max() > 12.0  # the error to correct
    off_m = np.linalg.norm(p_m - exact_m, axis=1) / sigmas(exact_cov).max(axis=1)
    assert off_m.max() < 0.8 and np.median(off_m) < 0.1
    assert sigmas(cov) == pytest.approx(sigmas(exact_cov), rel=0.06)
    one_sigma = np.sqrt(np.diagonal(exact_cov, axis1=1, axis2=2))
    off_rad = np.array([log_so3(r @ exact.T) for r, exact in zip(r_w_c, exact_r, strict=True)])
    assert np.median(np.abs(off_rad) / one_sigma[:, 3:]) < 0.1 and np.abs(off_rad / one_sigma[:, 3:]).max() < 1.0
    correlation = (cov - exact_cov) / one_sigma[:, :, None] / one_sigma[:, None, :]
    assert np.abs(correlation).max() < 0.2, "of position with rotation as well"


def test_a_factor_that_is_kept_does_not_hold_the_matrix_that_it_came_from() -> None:
    """240 nodes, of which 24 are retained: 14 kB of factors for each of these, and 500 kB of the matrices in which the
    nodes between them were eliminated. The trajectory begins with 1024 rows, 0.3 MB."""
    chain = Chain(240, fixes={*range(0, 240, 10)})
    gc.collect()
    tracemalloc.start()
    try:
        past = chain.flown(MarginalizedHistory())
        while past.reduce_step():
            pass
        kept = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert 20 <= len(past._retained) <= 24
    assert kept < 1.5e6


@pytest.mark.slow
def test_retained_nodes_and_factors_are_bounded_in_a_long_flight() -> None:
    past = Chain(1700, fixes=set(range(0, 1700, 20))).flown(MarginalizedHistory())
    assert marginalized.MAX_RETAINED - 2 <= len(past._retained) <= marginalized.MAX_RETAINED
    assert max(len(past._linear), len(past._values)) < marginalized.MAX_RETAINED + 3 * MAX_UNSEPARATED
    p_m, _, cov = past.refine()
    assert p_m.shape == (1700, 3) and np.isfinite(p_m).all()
    assert np.linalg.eigvalsh(cov).min() > 0.0


def test_a_stationary_vehicle_with_one_parent_node_is_refined_like_the_batch() -> None:
    """The parent node stays in the window meanwhile."""
    stationary = range(40, 240)
    chain = Chain(300, fixes={10, 20, 30, 260, 270, 280}, stationary=stationary)
    past = chain.flown(MarginalizedHistory())
    assert len(past._values) < 120
    p_m, _, cov = past.refine()
    exact_m, _, exact_cov = chain.batch()
    assert np.linalg.norm(p_m - exact_m, axis=1).max() < 0.3
    assert (sigmas(cov) / sigmas(exact_cov)).min() > 0.97


def test_a_reset_graph_is_refined_as_two_segments() -> None:
    first, second = Chain(48, fixes={0, 20}), Chain(30, fixes={0, 20}, seed=1)
    past = first.flown(MarginalizedHistory())
    past.begin_segment(48)
    second.flown(MarginalizedHistory())
    for factors in second.factors:
        past.add(_renumbered(factors, 48))
    past.marginalize(list(range(48, 78)), _later(second.left_with, 48, 30))
    p_m, _, cov = past.refine()
    for part, chain in ((slice(0, 48), first), (slice(48, 78), second)):
        exact_m, _, exact_cov = chain.batch()
        assert np.linalg.norm(p_m[part] - exact_m, axis=1).max() < 0.3
        assert sigmas(cov[part]) == pytest.approx(sigmas(exact_cov), rel=0.1)


def _renumbered(factors: gtsam.NonlinearFactorGraph, by: int) -> gtsam.NonlinearFactorGraph:
    moved = gtsam.NonlinearFactorGraph()
    for i in range(factors.size()):
        factor = factors.at(i)
        moved.push_back(factor.rekey([key + by for key in factor.keys()]))  # noqa: SIM118
    return moved


def _later(values: gtsam.Values, by: int, nodes: int) -> gtsam.Values:
    later = gtsam.Values()
    for i in range(nodes):
        later.insert(C(i + by), values.atPose3(C(i)))
        later.insert(B(i + by), values.atVector(B(i)))
        later.insert(V(i + by), values.atVector(V(i)))
    return later


def test_an_indeterminate_stretch_does_not_affect_the_rest_of_the_flight() -> None:
    """A factor with nan: the rest of the flight is refined."""
    past, bad = MarginalizedHistory(), gtsam.NonlinearFactorGraph()
    bad.add(gtsam.PriorFactorVector(V(52), np.full(MOTION_SIZE, np.nan), gtsam.noiseModel.Unit.Create(MOTION_SIZE)))
    past.add(bad)
    past.begin_segment = lambda node: None  # type: ignore[method-assign] # a segment starts at node 0 anyway
    p_m, _, cov = Chain(120, fixes=set(range(0, 120, 10))).flown(past).refine()
    lost = np.flatnonzero(~np.isfinite(p_m).all(axis=1))
    assert 52 in lost and len(lost) <= 2 * marginalized.MIN_SPACING
    assert np.isfinite(cov[np.isfinite(p_m).all(axis=1)]).all()
