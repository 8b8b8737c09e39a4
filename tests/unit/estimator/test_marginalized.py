"""What is kept of a flight for its refinement: exact where nodes are kept, honest between them, bounded in size."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, C, V

from terrafix.estimator.factors.custom_factors import BIAS_SIZE
from terrafix.estimator.graph import marginalized
from terrafix.estimator.graph.elimination import NODE, GaussianFactor, IndeterminateError, eliminate, solve
from terrafix.estimator.graph.fixed_lag import FixedLagSmoother
from terrafix.estimator.graph.marginalized import MOST_OPEN, MarginalizedHistory
from terrafix.estimator.models.motion_model import V_SIZE

STEP_M, TURN_RAD = np.array([6.0, 0.0, 0.0]), 0.02
ODOMETRY = np.array([0.003, 0.003, 0.006, 0.3, 0.3, 0.3])  # 1-sigma
FIX = np.array([0.02, 0.02, 0.02, 2.0, 2.0, 2.0])


def random_chain(nodes: int, rng: np.random.Generator) -> list[GaussianFactor]:
    """A prior, neighbours, and a node on which every third one hangs."""
    sides = [(0,), *((i, i + 1) for i in range(nodes - 1)), *((2, i) for i in range(5, nodes, 3))]
    return [GaussianFactor(s, rng.normal(size=(NODE, NODE * len(s))), rng.normal(size=NODE)) for s in sides]


def dense(factors: list[GaussianFactor], nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """By normal equations: changes (nodes, NODE), covariance (NODE * nodes, NODE * nodes)."""
    information, vector = np.zeros((NODE * nodes, NODE * nodes)), np.zeros(NODE * nodes)
    for f in factors:
        at = np.concatenate([np.arange(NODE) + NODE * n for n in f.nodes])
        information[np.ix_(at, at)] += f.by.T @ f.by
        vector[at] += f.by.T @ f.rhs
    cov = np.linalg.inv(information)
    return (cov @ vector).reshape(nodes, NODE), cov


def test_solving_node_by_node_is_solving_all_at_once() -> None:
    factors = random_chain(14, np.random.default_rng(1))
    mean, cov = dense(factors, 14)
    solved = solve(factors)
    assert sorted(solved) == list(range(14))
    for node, known in solved.items():
        change, its_cov = known.of([node])
        at = slice(NODE * node, NODE * (node + 1))
        assert change == pytest.approx(mean[node], rel=1e-6, abs=1e-8)
        assert its_cov == pytest.approx(cov[at, at], rel=1e-6, abs=1e-8)


def test_taking_nodes_out_changes_nothing_for_the_others() -> None:
    factors = random_chain(12, np.random.default_rng(2))
    before = solve(factors)
    for gone in ([6, 7], [4], [9, 10]):
        touching = [f for f in factors if set(gone) & set(f.nodes)]
        known, left = eliminate(touching, gone)
        factors = [f for f in factors if f not in touching] + [left]
        assert set(left.nodes) == set(known.given) == {n for f in touching for n in f.nodes} - set(gone)
    after = solve(factors)
    assert sorted(after) == [0, 1, 2, 3, 5, 8, 11]
    for node, known in after.items():
        (change, cov), (change_before, cov_before) = known.of([node]), before[node].of([node])
        assert change == pytest.approx(change_before, rel=1e-6, abs=1e-8)
        assert cov == pytest.approx(cov_before, rel=1e-6, abs=1e-8)


def test_what_nothing_holds_is_indeterminate() -> None:
    with pytest.raises(IndeterminateError):
        solve(random_chain(4, np.random.default_rng(3))[1:])  # without the prior
    with pytest.raises(IndeterminateError):
        solve([GaussianFactor((0,), np.full((NODE, NODE), np.nan), np.zeros(NODE))])


class Chain:
    """Nodes that leave the window as they do in flight, and the same factors for a batch optimisation."""

    def __init__(self, nodes: int, *, fixes: set[int], keyframes: int = 3, seed: int = 0, stands: range = range(0)):
        rng = np.random.default_rng([seed, 5])
        self.nodes, self.stands = nodes, stands
        self.factors: list[gtsam.NonlinearFactorGraph] = []
        self.steps: list[tuple[int, gtsam.Pose3]] = [(0, gtsam.Pose3())]  # parent, and the motion since by odometry
        self.said = gtsam.Values()  # estimates with which the nodes left; before that by odometry alone
        poses = [gtsam.Pose3()]
        for i in range(nodes):
            graph = gtsam.NonlinearFactorGraph()
            if i == 0:
                graph.add(gtsam.PriorFactorPose3(C(0), poses[0], gtsam.noiseModel.Diagonal.Sigmas(FIX)))
            else:
                step = np.zeros(6) if i in stands[1:] else np.array([0.0, 0.0, TURN_RAD, *STEP_M])
                poses.append(poses[-1].compose(gtsam.Pose3.Expmap(step)))
                parent = stands.start if i in stands[1:] else max(0, (i - 1) // keyframes * keyframes)
                noise = gtsam.Pose3.Expmap(ODOMETRY * rng.normal(size=6))
                self.steps.append((parent, poses[parent].between(poses[i]).compose(noise)))
                odometry = gtsam.noiseModel.Diagonal.Sigmas(ODOMETRY)
                graph.add(gtsam.BetweenFactorPose3(C(parent), C(i), self.steps[i][1], odometry))
                graph.add(
                    gtsam.BetweenFactorVector(
                        B(i - 1), B(i), np.zeros(BIAS_SIZE), gtsam.noiseModel.Unit.Create(BIAS_SIZE)
                    )
                )
                graph.add(
                    gtsam.BetweenFactorVector(V(i - 1), V(i), np.zeros(V_SIZE), gtsam.noiseModel.Unit.Create(V_SIZE))
                )
            graph.add(gtsam.PriorFactorVector(B(i), np.zeros(BIAS_SIZE), gtsam.noiseModel.Unit.Create(BIAS_SIZE)))
            graph.add(gtsam.PriorFactorVector(V(i), np.zeros(V_SIZE), gtsam.noiseModel.Unit.Create(V_SIZE)))
            if i in fixes:
                fix = poses[i].compose(gtsam.Pose3.Expmap(FIX * rng.normal(size=6)))
                graph.add(gtsam.PriorFactorPose3(C(i), fix, gtsam.noiseModel.Diagonal.Sigmas(FIX)))
            self.factors.append(graph)

    def flown(self, past: MarginalizedHistory) -> MarginalizedHistory:
        """Where the vehicle stands, the first node of that stays in the window until it moves again."""
        past.begin(0)
        lag, window = FixedLagSmoother(), list[int]()
        for i, (factors, (parent, motion)) in enumerate(zip(self.factors, self.steps, strict=True)):
            if i in self.stands[1:]:
                lag.keep(self.stands.start)
            leaving = lag.leaving(i)
            if leaving:
                past.leave(leaving, self._noted(lag, window))
            values = gtsam.Values()
            values.insert(C(i), lag.pose(parent).compose(motion) if i else motion)
            values.insert(B(i), np.zeros(BIAS_SIZE))
            values.insert(V(i), np.zeros(V_SIZE))
            lag.insert(i, factors, values)
            window = [n for n in window if n not in leaving] + [i]
            past.add(factors)
            past.tidy()
        past.leave(window, self._noted(lag, window))
        return past

    def _noted(self, lag: FixedLagSmoother, window: list[int]) -> gtsam.Values:
        values = lag.estimate()
        for n in window:
            for key in (C(n), B(n), V(n)):
                at = values.atPose3(key) if key == C(n) else values.atVector(key)
                self.said.insert_or_assign(key, at)
        return values

    def batch(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) and covariances (N, 3, 3) by GTSAM, everything at once."""
        graph = gtsam.NonlinearFactorGraph()
        for factors in self.factors:
            graph.push_back(factors)
        values = gtsam.LevenbergMarquardtOptimizer(graph, self.said).optimize()
        marginals = gtsam.Marginals(graph, values)
        poses = [values.atPose3(C(i)) for i in range(self.nodes)]
        turns = [p.rotation().matrix() for p in poses]
        cov = [r @ marginals.marginalCovariance(C(i))[3:, 3:] @ r.T for i, r in enumerate(turns)]
        return np.array([p.translation() for p in poses]), np.array(cov)


def sigmas(cov: np.ndarray) -> np.ndarray:
    """(N, 3, 3) -> (N, 2) horizontal."""
    return np.asarray(np.sqrt(cov[:, [0, 1], [0, 1]]))


@pytest.mark.parametrize("most_kept", [256, 12])
def test_it_is_the_batch_optimisation_of_the_whole_flight(most_kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A gap of 100 nodes without a fix, and 25 m to correct where it ends. What is left is what is not linear. How many
    nodes are kept makes no difference."""
    monkeypatch.setattr(marginalized, "MOST_KEPT", most_kept)
    chain = Chain(260, fixes={*range(10, 100, 10), *range(200, 260, 10)})
    past = chain.flown(MarginalizedHistory())
    p_m, cov = past.refine()
    assert len(past._kept) <= most_kept + 1 and len(past._linear) <= most_kept + 1
    exact_m, exact_cov = chain.batch()
    flown_m = np.array([chain.said.atPose3(C(i)).translation() for i in range(260)])
    assert np.linalg.norm(flown_m - exact_m, axis=1).max() > 12.0  # what there is to correct
    off_m = np.linalg.norm(p_m - exact_m, axis=1) / sigmas(exact_cov).max(axis=1)
    assert off_m.max() < 0.8 and np.median(off_m) < 0.1
    assert sigmas(cov) == pytest.approx(sigmas(exact_cov), rel=0.06)


def test_what_is_kept_stays_small_however_long_the_flight() -> None:
    past = Chain(1700, fixes=set(range(0, 1700, 20))).flown(MarginalizedHistory())
    assert marginalized.MOST_KEPT - 2 <= len(past._kept) <= marginalized.MOST_KEPT
    assert max(len(past._linear), len(past._left)) < marginalized.MOST_KEPT + 3 * MOST_OPEN
    p_m, cov = past.refine()
    assert p_m.shape == (1700, 3) and np.isfinite(p_m).all()
    assert np.linalg.eigvalsh(cov).min() > 0.0


def test_a_vehicle_that_stands_hangs_on_one_node_for_long() -> None:
    """That node stays in the window meanwhile."""
    stands = range(40, 240)
    chain = Chain(300, fixes={10, 20, 30, 260, 270, 280}, stands=stands)
    past = chain.flown(MarginalizedHistory())
    assert len(past._left) < 120
    p_m, cov = past.refine()
    exact_m, exact_cov = chain.batch()
    assert np.linalg.norm(p_m - exact_m, axis=1).max() < 0.3
    assert (sigmas(cov) / sigmas(exact_cov)).min() > 0.97


def test_a_graph_that_began_anew_leaves_two_parts() -> None:
    first, second = Chain(48, fixes={0, 20}), Chain(30, fixes={0, 20}, seed=1)
    past = first.flown(MarginalizedHistory())
    past.begin(48)
    second.flown(MarginalizedHistory())
    for factors in second.factors:
        past.add(_renumbered(factors, 48))
    past.leave(list(range(48, 78)), _later(second.said, 48, 30))
    p_m, cov = past.refine()
    for part, chain in ((slice(0, 48), first), (slice(48, 78), second)):
        exact_m, exact_cov = chain.batch()
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


def test_a_stretch_of_which_nothing_is_known_takes_only_itself() -> None:
    """A factor that is no number: the rest of the flight is refined."""
    past, bad = MarginalizedHistory(), gtsam.NonlinearFactorGraph()
    bad.add(gtsam.PriorFactorVector(V(52), np.full(V_SIZE, np.nan), gtsam.noiseModel.Unit.Create(V_SIZE)))
    past.add(bad)
    past.begin = lambda node: None  # type: ignore[method-assign] # it forgets what was before, and node 0 begins anyway
    p_m, cov = Chain(120, fixes=set(range(0, 120, 10))).flown(past).refine()
    lost = np.flatnonzero(~np.isfinite(p_m).all(axis=1))
    assert 52 in lost and len(lost) <= 2 * marginalized.SPACING
    assert np.isfinite(cov[np.isfinite(p_m).all(axis=1)]).all()
