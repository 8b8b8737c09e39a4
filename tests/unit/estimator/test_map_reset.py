"""A graph that begins anew at a map match: its covariance, and the height that the barometer keeps."""

import msgspec
import numpy as np
import pytest

from map_matches import with_search
from simulated_flight import EstimatorRun, Flight, without_fix
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.measurements.map_pose import MapPoseMeasurement
from terrafix.estimator.state import VELOCITY
from terrafix.messages import MapMatch, MatchPlace, Prediction, Verdict

FRAMES = 14
FAR_M = (300.0, -200.0)
INFLATION = 4.0  # of the covariance of the match
STEP_SHARE = 0.04  # of the motion since the match


@pytest.fixture
def flown() -> tuple[EstimatorRun, Flight]:
    flight = Flight(FRAMES, seed=6, dem=True)
    return EstimatorRun().fly(flight, 0, FRAMES), flight


def newest(run: EstimatorRun) -> tuple[Estimator, FrameState]:
    estimator = run.node._estimator
    assert estimator is not None and estimator.last is not None
    return estimator, estimator.last


def found(flight: Flight, i: int, up_m: float = 0.0) -> MapMatch:
    """A place that a search has found, FAR_M from the truth and ``up_m`` above it."""
    match = with_search(flight.fix(i, offset_m=FAR_M), relocalized=True)
    assert match.pose is not None
    e_m, n_m, z_m = match.pose.p_c_in_w_m
    return msgspec.structs.replace(match, pose=msgspec.structs.replace(match.pose, p_c_in_w_m=(e_m, n_m, z_m + up_m)))


def test_a_graph_that_begins_anew_has_the_inflated_covariance_of_its_match(flown: tuple[EstimatorRun, Flight]) -> None:
    run, flight = flown
    estimator, _ = newest(run)
    match = found(flight, FRAMES - 1)
    measured = MapPoseMeasurement.of(match, estimator.terrain, estimator.state.radial_k1_estimate)
    run.feed([match])
    assert "found" in run.verdicts("map")[FRAMES - 1].detail
    assert newest(run)[1].cov == pytest.approx(INFLATION * measured.cov, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("frames_late", [2, 5])
def test_a_match_that_comes_late_has_the_error_of_the_motion_since_then(
    flown: tuple[EstimatorRun, Flight], frames_late: int
) -> None:
    run, flight = flown
    estimator, last = newest(run)
    frame = FRAMES - 1 - frames_late
    state, node = estimator.state, estimator.state.node_of[frame]
    match = found(flight, frame)
    measured = MapPoseMeasurement.of(match, estimator.terrain, state.radial_k1_estimate)
    onward = state.graph.state(node).pose.between(last.pose)
    velocity_sigma = np.sqrt(np.linalg.eigvalsh(state.motion_cov[VELOCITY, VELOCITY])[-1])
    dt_s = last.t_s - state.graph.time_of(node)
    run.feed([match])
    moved = onward.inverse().AdjointMap()
    added = newest(run)[1].cov - INFLATION * moved @ measured.cov @ moved.T
    way_m = np.linalg.norm(onward.translation())
    assert way_m > 10.0
    expected_m2 = (STEP_SHARE * way_m) ** 2 + (velocity_sigma * dt_s) ** 2
    assert added[3:, 3:] == pytest.approx(expected_m2 * np.eye(3), rel=0.01, abs=0.02)


def test_a_place_found_at_another_height_keeps_the_height_of_the_barometer(flown: tuple[EstimatorRun, Flight]) -> None:
    """The ground lies at another height there; the reported height is that of the vehicle as before."""
    run, flight = flown
    estimator, last = newest(run)
    barometric_m = estimator.graph.state(last.node).barometric_up_m
    up_m = float(last.pose.translation()[2])
    run.feed([found(flight, FRAMES - 1, up_m=40.0)])
    after = newest(run)[1]
    assert float(after.pose.translation()[2]) - up_m == pytest.approx(40.0, abs=10.0)
    assert estimator.graph.state(after.node).barometric_up_m == pytest.approx(barometric_m, abs=0.1)


@pytest.mark.parametrize(("mass", "restarts"), [(0.98, True), (0.96, False)])
def test_only_matches_in_a_mode_with_almost_all_mass_restart_the_graph(mass: float, restarts: bool) -> None:
    """They agree with each other, 120 m from the estimate, over a hundred metres of flight."""
    flight = Flight(30, seed=6, dem=True)
    run = EstimatorRun().fly(flight, 0, 10)
    details = []
    for i in range(10, 30):
        run.fly(flight, i, i + 1, without_fix)
        match = flight.fix(i, offset_m=(120.0, 0.0))
        assert match.place is not None
        place = MatchPlace(e_m=match.place.e_m, n_m=match.place.n_m, mass=mass)
        run.feed([msgspec.structs.replace(match, place=place)])
        details.append(run.verdicts("map")[i].detail)
        if "restarted" in details[-1]:
            break
        assert run.verdicts("map")[i].verdict is Verdict.INNOVATION
    assert any("restarted" in detail for detail in details) is restarts


def test_images_that_fit_worse_at_an_alternative_position_end_it() -> None:
    """Two matches 120 m off agree with each other; frames that are predicted after them are compared with both."""
    flight, away_m = Flight(20, seed=6, dem=True), np.array([120.0, 0.0])
    run = EstimatorRun().fly(flight, 0, 10)
    for i in (10, 11):
        run.fly(flight, i, i + 1, without_fix)
        run.feed([flight.fix(i, offset_m=(120.0, 0.0))])
    run.fly(flight, 12, 13, without_fix)
    predictions = {message.frame_id: message for message in run.published if isinstance(message, Prediction)}
    assert predictions[11].alternative_m is None and predictions[12].alternative_m is not None
    off_m = np.subtract(predictions[12].alternative_m, predictions[12].p_c_in_w_m[:2])
    assert float(np.hypot(*(off_m - away_m))) < 15.0
    weights = []
    for frame in (11, 12):
        run.feed([msgspec.structs.replace(flight.fix(frame), alternative_nats=-4.0)])
        assert run.verdicts("map")[frame].verdict is Verdict.ACCEPTED
        weights.append(newest(run)[0].hypotheses.other.weight)
    assert weights == [pytest.approx(0.5, abs=0.01), 0.0]
