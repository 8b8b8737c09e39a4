"""Covariance modes: under thermal throttle the covariance is propagated and the smoother computes no marginals."""

import numpy as np
import pytest

from inertial_flight import InertialFlight, flown
from map_matches import with_search
from simulated_flight import KEYFRAME_EVERY, EstimatorRun, Flight, cov_of, error_m, sigma_m, without_sight
from smoother_marginals import JOINT, MARGINAL, recorded_marginals
from terrafix.core.limits import WINDOW_NODES
from terrafix.core.pose import log_so3
from terrafix.estimator.claim import claim
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.graph.pose_graph import rebuild_prior
from terrafix.estimator.state import VELOCITY
from terrafix.messages import CovarianceMode, Health, MapMatch, ThermalBand, Verdict

HOT_FROM, COOL_FROM, END = 12, 24, 28
FIX = 18  # frame of the map match in the hot stretch


def health(band: ThermalBand) -> Health:
    return Health(t_ns=0, band=band, temperature_c=60.0, throttled=False, disk_free_mb=1000, cause="test")


def newest(run: EstimatorRun) -> tuple[Estimator, FrameState]:
    estimator = run.node.estimator
    assert estimator is not None and estimator.last is not None
    return estimator, estimator.last


def hot_run(flight: Flight, until: int) -> EstimatorRun:
    """Cool until HOT_FROM, then hot."""
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    return run.fly(flight, HOT_FROM, until)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The marginals that smoothers compute."""
    return recorded_marginals(monkeypatch)


# --- no marginals -------------------------------------------------------------------------------------------------


def test_under_thermal_throttle_no_marginal_is_computed_after_the_change_of_mode(computed: list[str]) -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, HOT_FROM)
    assert set(computed) == {MARGINAL}
    run.feed([health(ThermalBand.HOT)])
    computed.clear()
    run.fly(flight, HOT_FROM, HOT_FROM + 1)
    assert computed == [JOINT] * HOT_FROM  # of each node in the window, to propagate from
    computed.clear()
    run.fly(flight, HOT_FROM + 1, COOL_FROM)
    assert computed == []
    assert {run.estimate(i).covariance_mode for i in range(HOT_FROM, COOL_FROM)} == {CovarianceMode.JACOBIAN}
    assert run.verdicts("map")[FIX].verdict is Verdict.ACCEPTED
    run.feed([health(ThermalBand.NORMAL)])
    run.fly(flight, COOL_FROM, COOL_FROM + 1)
    assert set(computed) == {MARGINAL}


def test_under_thermal_throttle_late_matches_restarts_and_lost_odometry_need_no_marginal(computed: list[str]) -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun()
    run.feed([health(ThermalBand.HOT)])
    run.fly(flight, 0, FIX)
    run.feed([flight.fix(FIX - 4)])
    assert run.verdicts("map")[FIX - 4].verdict is Verdict.ACCEPTED
    run.feed([with_search(flight.fix(FIX - 1, offset_m=(300.0, -200.0)), relocalized=True)])
    assert "found" in run.verdicts("map")[FIX - 1].detail
    run.fly(flight, FIX, END, without_sight)
    assert computed == []
    assert run.estimate(END - 1).covariance_mode is CovarianceMode.JACOBIAN


def test_under_thermal_throttle_airspeed_in_a_blackout_needs_no_marginal(computed: list[str]) -> None:
    run = flown(InertialFlight(seed=4, seconds=76), imu=True, blind=(70, 75), airspeed=True, band=ThermalBand.HOT)
    fused = [v for v in run.verdicts if v.measurement == "airspeed" and v.verdict is Verdict.ACCEPTED]
    assert len(fused) >= 5
    assert computed == []


# --- the propagated covariance ------------------------------------------------------------------------------------


def test_under_thermal_throttle_the_published_covariance_is_the_propagated_one() -> None:
    flight = Flight(END, seed=2)
    run = hot_run(flight, HOT_FROM)
    for i in range(HOT_FROM, COOL_FROM):
        run.fly(flight, i, i + 1)
        estimator, last = newest(run)
        assert np.array_equal(last.cov, estimator.state.covariances.pose(last.node))
        assert not np.array_equal(last.cov, estimator.graph.covariance(last.node))
        assert np.array_equal(last.velocity_cov, estimator.state.covariances.motion(last.node)[VELOCITY, VELOCITY])


def test_propagation_begins_with_the_marginals_of_the_window() -> None:
    run = EstimatorRun().fly(Flight(END, seed=2), 0, HOT_FROM)
    state = newest(run)[0].state
    state.covariances.set_mode(CovarianceMode.JACOBIAN)
    for node in state.graph.window:
        assert state.covariances.pose(node) == pytest.approx(state.graph.covariance(node), rel=1e-6, abs=1e-12)
        assert state.covariances.motion(node) == pytest.approx(state.graph.motion_covariance(node), rel=1e-6, abs=1e-12)
        assert state.covariances.calibration(node) == pytest.approx(
            state.graph.calibration_covariance(node), rel=1e-6, abs=1e-12
        )


def test_a_flight_that_begins_hot_begins_with_the_covariance_of_the_graph() -> None:
    """One node: with the reported attitude and height."""
    run = EstimatorRun()
    run.feed([health(ThermalBand.HOT)])
    estimator, last = newest(run.fly(Flight(1, seed=2, fix_every=100), 0, 1))
    state, graph = estimator.state, estimator.graph
    assert state.covariances.pose(last.node) == pytest.approx(graph.covariance(last.node), rel=1e-3, abs=1e-9)
    assert state.covariances.calibration(last.node) == pytest.approx(
        graph.calibration_covariance(last.node), rel=1e-3, abs=1e-9
    )


def test_the_propagated_covariance_grows_with_the_way_and_shrinks_with_a_map_match() -> None:
    flight = Flight(60, seed=2, fix_every=100)
    run = hot_run(flight, 60)
    sigmas_m = [sigma_m(run.estimate(i)) for i in range(HOT_FROM, 60, 6)]
    assert (np.diff(sigmas_m) > 0.0).all()
    run.feed([flight.fix(59)])
    assert sigma_m(run.estimate(59)) < 0.5 * sigmas_m[-1]


def test_a_late_map_match_improves_all_nodes_of_the_window_and_the_frames_after_it() -> None:
    """But those whose keyframe has left the window, which nothing joins to the match."""
    flight = Flight(40, seed=2, fix_every=100)
    run = hot_run(flight, 38)
    state = newest(run)[0].state
    joined = [
        node for node in state.graph.window if node >= -(-state.graph.window[0] // KEYFRAME_EVERY) * KEYFRAME_EVERY
    ]
    before = {node: state.covariance(node) for node in joined}
    assert len(before) > WINDOW_NODES - KEYFRAME_EVERY
    run.feed([flight.fix(34)])
    assert run.verdicts("map")[34].verdict is Verdict.ACCEPTED
    for node, cov in before.items():
        assert np.linalg.slogdet(state.covariance(node))[1] < np.linalg.slogdet(cov)[1] - 0.5, f"node {node}"
        assert (np.linalg.eigvalsh(cov - state.covariance(node)) > -1e-9).all(), f"node {node}"
    fixed = sigma_m(run.estimate(37))
    assert sigma_m(run.fly(flight, 38, 39).estimate(38)) < 1.2 * fixed


@pytest.mark.parametrize("telemetry", [{"yaw", "attitude", "height"}, {"attitude", "height"}, {"yaw", "attitude"}])
@pytest.mark.parametrize("dem", [False, True])
def test_the_propagated_covariance_is_close_to_the_marginal(telemetry: set[str], dem: bool) -> None:
    """Attitude and height are known about as well as in the smoother, so that the anchor searches no more."""
    flight = Flight(60, seed=4, dem=dem, telemetry=frozenset(telemetry))
    run = EstimatorRun()
    run.feed([health(ThermalBand.HOT)])
    ratios = []
    for i in range(60):
        run.fly(flight, i, i + 1)
        estimator, last = newest(run)
        marginal = estimator.graph.covariance(last.node)
        ratios.append(np.sqrt(last.cov.diagonal() / marginal.diagonal()))
    found = np.array(ratios[HOT_FROM:])
    assert (np.median(found, axis=0) < 1.25).all()
    assert found.max() < 2.0 and found.min() > 0.85
    assert (np.median(found, axis=0) > 0.98).all()


@pytest.mark.parametrize("fix_every", [9, 100])
def test_the_propagated_covariance_covers_the_errors(fix_every: int) -> None:
    """Position, heading and velocity: mean of the squared Mahalanobis distance, for 2, 3 and 2 degrees of freedom."""
    position, rotation, velocity = [], [], []
    for seed in range(6):
        flight = Flight(60, seed=seed, dem=True, fix_every=fix_every)
        run = EstimatorRun()
        run.feed([health(ThermalBand.CRITICAL)])
        for i in range(59):
            run.fly(flight, i, i + 1)
            if i < HOT_FROM:
                continue
            last, estimate = newest(run)[1], run.estimate(i)
            off, cov = error_m(estimate, flight)[:2], cov_of(estimate)[:2, :2]
            position.append(off @ np.linalg.solve(cov, off))
            turned = log_so3(last.pose.rotation().matrix().T @ flight.r_w_c[i])
            rotation.append(turned @ np.linalg.solve(last.cov[:3, :3], turned))
            off_mps = last.velocity_mps[:2] - (flight.p_m[i + 1] - flight.p_m[i - 1])[:2]  # in the second between
            velocity.append(off_mps @ np.linalg.solve(last.velocity_cov[:2, :2], off_mps))
    assert np.mean(position) < 2.5 and np.mean(rotation) < 3.0 and np.mean(velocity) < 2.0
    assert np.mean(np.array(position) < 5.99) > 0.93  # 95 % by its distribution
    assert np.mean(np.array(rotation) < 7.81) > 0.95


def test_the_propagated_velocity_covariance_covers_stops_and_starts() -> None:
    """They lie in the tail of the motion factor, which has less weight then. Mean of the squared Mahalanobis distance
    for 2 degrees of freedom."""
    distances = []
    for seed in range(4):
        flight = Flight(90, seed=seed, stop_and_go=True)
        run = EstimatorRun()
        run.feed([health(ThermalBand.HOT)])
        run.fly(flight, 0, HOT_FROM)
        for i in range(HOT_FROM, 89):
            run.fly(flight, i, i + 1)
            last = newest(run)[1]
            off_mps = last.velocity_mps[:2] - (flight.p_m[i + 1] - flight.p_m[i - 1])[:2]  # in the second between
            distances.append(off_mps @ np.linalg.solve(last.velocity_cov[:2, :2], off_mps))
    assert np.mean(distances) < 2.5


def test_a_map_match_over_known_ground_adds_its_share_of_information_to_the_propagated_covariance() -> None:
    """One frame later most of the ground is known."""
    flight = Flight(END, seed=2)
    run = hot_run(flight, FIX)
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


# --- changes of mode and of the graph -----------------------------------------------------------------------------


def test_the_first_frame_after_cooling_has_the_marginal_again() -> None:
    flight = Flight(END, seed=2)
    run = hot_run(flight, COOL_FROM)
    run.feed([health(ThermalBand.NORMAL)])
    for i in range(COOL_FROM, END):
        run.fly(flight, i, i + 1)
        estimator, last = newest(run)
        assert run.estimate(i).covariance_mode is CovarianceMode.MARGINALS
        assert np.array_equal(last.cov, estimator.graph.covariance(last.node))
        assert np.array_equal(last.velocity_cov, estimator.graph.motion_covariance(last.node)[:3, :3])


def test_where_marginals_return_the_claim_does_not_step_and_narrows_by_a_twentieth_a_frame() -> None:
    """The propagated covariance is made three times as wide, which makes its sigma 1.7 times as large as that of the
    marginals: it was in flights."""
    flight = Flight(END, seed=2)
    run = hot_run(flight, COOL_FROM)
    estimator, last = newest(run)
    covariances = estimator.state.covariances
    assert covariances._propagated is not None
    covariances._propagated.begin(last.node, 3.0 * estimator.graph.joint_covariance(last.node))
    hot = claim(estimator, estimator.state.frame_state(last.node), 0.0, 0.0)
    covariances.set_mode(CovarianceMode.MARGINALS)
    cool = claim(estimator, estimator.state.frame_state(last.node), 0.0, 0.0)
    assert covariances.widening == pytest.approx(3.0**0.5)
    assert cool.terms_m2["graph"] == pytest.approx(hot.terms_m2["graph"])
    run.feed([health(ThermalBand.NORMAL)])
    run.fly(flight, COOL_FROM, COOL_FROM + 1)
    assert covariances.widening == pytest.approx(0.95 * 3.0**0.5)
    covariances.widening = 1.02
    run.fly(flight, COOL_FROM + 1, COOL_FROM + 2)
    assert covariances.widening == 1.0


def _without_a_solution(run: EstimatorRun, flight: Flight, i: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Frame ``i``, whose update of the smoother fails."""
    with monkeypatch.context() as broken:
        graph = newest(run)[0].graph
        broken.setattr(graph._smoother, "insert", _indeterminate)
        run.fly(flight, i, i + 1)
    assert graph.rebuilds == 1


def _indeterminate(*_: object) -> None:
    raise RuntimeError("indeterminate")


def test_under_thermal_throttle_a_graph_that_is_rebuilt_is_as_uncertain_as_its_prior(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    flight = Flight(END, seed=2, fix_every=100)
    run = hot_run(flight, FIX)
    _without_a_solution(run, flight, FIX, monkeypatch)
    estimator, last = newest(run)
    prior = rebuild_prior(estimator.graph.state(last.node))
    assert last.cov == pytest.approx(prior.pose_cov)
    run.fly(flight, FIX + 1, FIX + 2)
    assert sigma_m(run.estimate(FIX + 1)) > 0.9 * np.sqrt(prior.pose_cov[3, 3])


def test_a_rebuild_before_the_change_of_mode_leaves_no_trace_in_propagation(monkeypatch: pytest.MonkeyPatch) -> None:
    flight = Flight(END, seed=2)
    run = EstimatorRun().fly(flight, 0, 5)
    _without_a_solution(run, flight, 5, monkeypatch)
    run.fly(flight, 6, HOT_FROM)
    run.feed([health(ThermalBand.HOT)])
    run.fly(flight, HOT_FROM, HOT_FROM + 1)
    estimator, last = newest(run)
    marginal = estimator.graph.covariance(last.node)
    assert np.trace(last.cov[3:, 3:]) == pytest.approx(np.trace(marginal[3:, 3:]), rel=0.1)


def test_propagation_holds_the_nodes_of_the_window_alone() -> None:
    estimator, _ = newest(hot_run(Flight(60, seed=2), 60))
    propagated = estimator.state.covariances._propagated
    assert propagated is not None
    assert set(propagated._cov) == set(propagated._cross) == set(estimator.graph.window)
