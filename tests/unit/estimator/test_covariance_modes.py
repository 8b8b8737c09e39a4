"""Covariance modes: under thermal throttle the covariance is propagated and the smoother computes no marginals."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from simulated_flight import KEYFRAME_EVERY, EstimatorRun, Flight, cov_of, sigma_m
from terrafix.core.pose import exp_so3
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.graph.pose_graph import PoseGraph
from terrafix.messages import CovarianceMode, Health, MapMatch, ThermalBand, Verdict

HOT_FROM, COOL_FROM, END = 12, 24, 28
FIX = 18  # frame of the map match in the hot stretch


def health(band: ThermalBand) -> Health:
    return Health(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")


def estimator_of(run: EstimatorRun) -> Estimator:
    estimator = run.node._estimator
    assert estimator is not None
    return estimator


def newest(run: EstimatorRun) -> tuple[Estimator, FrameState]:
    estimator = estimator_of(run)
    assert estimator.last is not None
    return estimator, estimator.last


def marginal_of(run: EstimatorRun) -> np.ndarray:
    """(6, 6): the smoother's marginal of the newest pose."""
    estimator, last = newest(run)
    return estimator.graph.covariance(last.node)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the marginals that a graph computes from here on."""
    names: list[str] = []

    def recorded(name: str) -> Callable[[PoseGraph, int], np.ndarray]:
        compute = getattr(PoseGraph, name)

        def marginal(graph: PoseGraph, node: int) -> np.ndarray:
            names.append(name)
            return np.asarray(compute(graph, node))

        return marginal

    for name in ("covariance", "velocity_covariance", "bias_covariance"):
        monkeypatch.setattr(PoseGraph, name, recorded(name))
    return names


def test_under_thermal_throttle_no_marginal_is_computed(computed: list[str]) -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    assert {"covariance", "velocity_covariance", "bias_covariance"} <= set(computed)
    run.feed([health(ThermalBand.HOT)])
    for i in range(HOT_FROM, COOL_FROM):
        computed.clear()
        run.fly(flight, i, i + 1)
        assert computed == [], f"frame {i}"
        assert run.estimate(i).covariance_mode is CovarianceMode.JACOBIAN
    assert run.verdicts("map")[FIX].verdict is Verdict.ACCEPTED
    run.feed([health(ThermalBand.NORMAL)])
    computed.clear()
    run.fly(flight, COOL_FROM, COOL_FROM + 1)
    assert {"covariance", "velocity_covariance", "bias_covariance"} <= set(computed)


def test_under_thermal_throttle_the_published_covariance_is_the_propagated_one() -> None:
    """It differs from the marginal in every frame, and from the covariance of a vehicle that stayed cool."""
    flight = Flight(END, seed=2)
    cool, hot = (EstimatorRun().fly(flight, 0, HOT_FROM) for _ in range(2))
    hot.feed([health(ThermalBand.HOT)])
    for i in range(HOT_FROM, COOL_FROM):
        cool.fly(flight, i, i + 1)
        hot.fly(flight, i, i + 1)
        _, last = newest(hot)
        ratio = np.trace(last.cov[3:, 3:]) / np.trace(marginal_of(hot)[3:, 3:])
        assert abs(ratio - 1.0) > 0.02, f"frame {i}: {ratio}"
        assert not np.allclose(cov_of(hot.estimate(i)), cov_of(cool.estimate(i)), rtol=0.02)


def test_the_propagated_covariance_grows_from_frame_to_frame_and_shrinks_with_a_map_match() -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    run.fly(flight, HOT_FROM, COOL_FROM)
    keyframe = (HOT_FROM + KEYFRAME_EVERY - 1) // KEYFRAME_EVERY * KEYFRAME_EVERY
    sigmas_m = [sigma_m(run.estimate(i)) for i in range(keyframe, FIX, KEYFRAME_EVERY)]
    assert (np.diff(sigmas_m) > 0.0).all()
    assert sigma_m(run.estimate(FIX)) < sigmas_m[-1]


def test_the_first_frame_after_cooling_has_the_marginal_again() -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    run.fly(flight, HOT_FROM, COOL_FROM)
    run.feed([health(ThermalBand.NORMAL)])
    for i in range(COOL_FROM, END):
        run.fly(flight, i, i + 1)
        estimator, last = newest(run)
        assert run.estimate(i).covariance_mode is CovarianceMode.MARGINALS
        assert np.array_equal(last.cov, estimator.graph.covariance(last.node))
        assert np.array_equal(last.velocity_cov, estimator.graph.velocity_covariance(last.node)[:3, :3])


def test_the_covariance_of_a_composed_pose_is_that_of_its_parts_to_first_order() -> None:
    """Jacobians by finite differences of the composition itself."""
    parent = gtsam.Pose3(gtsam.Rot3(exp_so3(np.array([0.2, -0.1, 1.1]))), np.array([30.0, -20.0, 100.0]))
    r, p_m = exp_so3(np.array([0.05, 0.1, -0.4])), np.array([12.0, 3.0, -2.0])
    between, step = gtsam.Pose3(gtsam.Rot3(r), p_m), 1e-6
    composed = parent.compose(between)
    axes = step * np.eye(6)
    by_parent = np.array([composed.localCoordinates(parent.retract(e).compose(between)) for e in axes]).T / step
    by_motion = np.array([composed.localCoordinates(parent.compose(between.retract(e))) for e in axes]).T / step
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 6, 6))
    parent_cov, motion_cov = a @ a.T, b @ b.T
    expected = by_parent @ parent_cov @ by_parent.T + by_motion @ motion_cov @ by_motion.T


def test_a_map_match_over_known_ground_adds_its_share_of_information_to_the_propagated_covariance() -> None:
    """One frame later most of the ground is known."""
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    run.fly(flight, HOT_FROM, FIX)
    gained, shares = [], []
    for i in (FIX, FIX + 1):
        run.feed(m for m in flight.messages(i) if not isinstance(m, MapMatch))
        before = newest(run)[1].cov
        run.feed([flight.fix(i)])
        gained.append(np.linalg.inv(newest(run)[1].cov) - np.linalg.inv(before))
        shares.append(float(run.verdicts("map")[i].detail.split()[-1]))
    assert shares[0] > 0.9 and 0.1 < shares[1] < 0.2
    expected = np.full(6, shares[1] / shares[0])
    assert gained[1].diagonal() / gained[0].diagonal() == pytest.approx(expected, rel=0.15)


def _hot_flight_until_the_fix() -> tuple[EstimatorRun, Flight]:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    return run.fly(flight, HOT_FROM, FIX), flight


def test_under_thermal_throttle_a_map_match_improves_its_keyframe_and_the_frames_after_it() -> None:
    run, flight = _hot_flight_until_the_fix()
    state = estimator_of(run).state
    without = {n: np.linalg.slogdet(cov)[1] for n, cov in state.cov_of.items()}
    run.fly(flight, FIX, FIX + 1)
    node = state.node_of[FIX]
    keyframe, motion_cov = state.motion_of[node]
    back = state.graph.state(keyframe).pose.between(state.graph.state(node).pose).AdjointMap()
    assert state.cov_of[keyframe] == pytest.approx(back @ (state.cov_of[node] + motion_cov) @ back.T)
    assert np.linalg.slogdet(state.cov_of[keyframe])[1] < without[keyframe]
    fixed, after = sigma_m(run.estimate(FIX)), run.fly(flight, FIX + 1, FIX + 2).estimate(FIX + 1)
    assert sigma_m(after) < 1.5 * fixed


def test_under_thermal_throttle_the_propagated_covariance_is_not_smaller_than_the_marginal() -> None:
    run, flight = _hot_flight_until_the_fix()
    for i in range(FIX, COOL_FROM):
        run.fly(flight, i, i + 1)
        estimator, last = newest(run)
        propagated, marginal = estimator.state.cov_of[last.node], marginal_of(run)
        for part in (slice(0, 3), slice(3, 6)):
            assert np.trace(propagated[part, part]) > 0.95 * np.trace(marginal[part, part]), f"frame {i}"
