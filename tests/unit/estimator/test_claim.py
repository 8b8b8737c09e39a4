"""The claim: named terms whose sum is the published covariance."""

from itertools import pairwise

import msgspec
import numpy as np
import pytest

from simulated_flight import CAMERA, ORIGIN, EstimatorRun, Flight
from terrafix.core.map_error import ILLUMINATION_SIGMA_M
from terrafix.core.pose import tangent_to_world
from terrafix.estimator.claim import claim
from terrafix.estimator.estimator import Estimator
from terrafix.estimator.filter_state import FrameState
from terrafix.estimator.measurements.principal_point import PrincipalPointFilter
from terrafix.estimator.state import HEIGHT
from terrafix.messages import ClaimBudget, LensEstimate, MapMatch, NavEstimate

FRAMES = 24
TERMS = {"graph", "map", "illumination", "principal_point", "time_offset", "hypotheses", "calibration"}


@pytest.fixture(scope="module")
def run() -> EstimatorRun:
    return EstimatorRun().fly(Flight(FRAMES, seed=4, dem=True), 0, FRAMES)


def test_the_terms_add_up_to_the_published_horizontal_variance(run: EstimatorRun) -> None:
    budgets = [m for m in run.published if isinstance(m, ClaimBudget)]
    assert len(budgets) > 5
    for budget in budgets:
        estimate = next(m for m in run.published if isinstance(m, NavEstimate) and m.frame_id == budget.frame_id)
        assert set(budget.terms_m2) == TERMS
        assert sum(budget.terms_m2.values()) == pytest.approx(0.5 * (estimate.cov[0] + estimate.cov[7]))


def test_a_matched_map_adds_the_variance_that_it_states_and_that_of_shadows() -> None:
    run, flight = EstimatorRun(), Flight(FRAMES, seed=4, dem=True)
    run.feed([ORIGIN])
    for message in flight.all_messages():
        run.feed([msgspec.structs.replace(message, map_sigma_m=3.0) if isinstance(message, MapMatch) else message])
    budget = next(m for m in run.published if isinstance(m, ClaimBudget))
    assert budget.terms_m2["map"] == pytest.approx(9.0)
    assert budget.terms_m2["illumination"] == pytest.approx(ILLUMINATION_SIGMA_M**2)


def test_before_the_first_match_neither_map_nor_shadows_are_in_the_claim(placed: tuple[Estimator, FrameState]) -> None:
    assert placed[0].map_sigma_m == 0.0
    terms = claim(*placed, 0.0, 0.0).terms_m2
    assert terms["map"] == terms["illumination"] == 0.0


def test_the_budget_is_published_once_a_second_after_the_first_map_match(run: EstimatorRun) -> None:
    times_s = [m.t_ns * 1e-9 for m in run.published if isinstance(m, ClaimBudget)]
    assert min(b - a for a, b in pairwise(times_s)) >= 1.0


# --- each term --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def placed(run: EstimatorRun) -> tuple[Estimator, FrameState]:
    """The estimator after the flight and its newest frame; no other position is supported there."""
    estimator = run.node._estimator
    assert estimator is not None and estimator.last is not None and not estimator.hypotheses.is_multimodal
    return estimator, estimator.last


def test_the_time_offset_widens_the_position_along_the_velocity(placed: tuple[Estimator, FrameState]) -> None:
    added = claim(*placed, 0.2, 0.0).cov - claim(*placed, 0.0, 0.0).cov
    v = placed[1].velocity_mps
    assert np.linalg.norm(v) > 10.0
    expected = np.zeros((6, 6))
    expected[:3, :3] = 0.2**2 * np.outer(v, v)
    assert added == pytest.approx(expected)


def test_a_wrong_calibration_widens_the_horizontal_position_alike_in_all_directions(
    placed: tuple[Estimator, FrameState],
) -> None:
    added = claim(*placed, 0.0, 7.0).cov - claim(*placed, 0.0, 0.0).cov
    assert added == pytest.approx(np.diag([49.0, 49.0, 0.0, 0.0, 0.0, 0.0]))


def test_tilt_and_height_have_what_the_graph_cannot_know_beside_its_covariance(
    placed: tuple[Estimator, FrameState],
) -> None:
    """A constant tilt of the autopilot looks like one of the mount; the barometer's scale like one of the height."""
    estimator, frame = placed
    added = claim(estimator, frame, 0.0, 0.0).cov - tangent_to_world(frame.cov, frame.pose.rotation().matrix())
    tilt = np.radians(ORIGIN.attitude_sigma_deg)
    _, amsl_sigma_m = estimator.state.amsl(frame)
    assert amsl_sigma_m > 0.3 and estimator.map_sigma_m == 0.0
    assert added.diagonal()[2:] == pytest.approx([amsl_sigma_m**2, tilt**2, tilt**2, 0.0])


@pytest.mark.parametrize(("apart_m", "beyond_m"), [(1.0, 0.0), (25.0, 24.0), (-25.0, 24.0)])
def test_images_and_barometer_that_differ_widen_the_height(
    placed: tuple[Estimator, FrameState], apart_m: float, beyond_m: float
) -> None:
    """A lens that zooms moves the images, weather the barometer. With a DEM both are heights above the sea."""
    estimator, frame = placed
    state = estimator.state
    calibration = state.graph.state(frame.node).calibration
    before, kept = state.amsl(frame), calibration.copy()
    calibration[HEIGHT] = apart_m
    amsl_m, sigma_m = state.amsl(frame)
    calibration[:] = kept
    assert state.terrain.has_dem and amsl_m == before[0]
    assert sigma_m == pytest.approx(np.hypot(before[1], beyond_m), abs=2.0)


def test_a_learnt_principal_point_shifts_the_position_by_its_lever() -> None:
    """Right in the image by 0.02 of the depth: the camera is that much to the right of the graph's."""
    run = EstimatorRun().fly(Flight(FRAMES, seed=4, dem=True), 0, FRAMES)
    estimator = run.node._estimator
    assert estimator is not None and estimator.last is not None
    frame, state = estimator.last, estimator.state
    before = claim(estimator, frame, 0.0, 0.0)
    sigmas = np.array([0.01, 0.01, 5e-4, 5e-4, 0.01, 0.003, 0.004])
    value = (0.0, 0.0, 0.0, 0.0, 0.0, 0.02, -0.01)
    learnt = LensEstimate(value=value, information=tuple(map(float, np.diag(sigmas**-2).ravel())))
    state.principal_point = PrincipalPointFilter(msgspec.structs.replace(CAMERA, focal_sigma=0.1), learnt)
    after = claim(estimator, frame, 0.0, 0.0)
    r_w_c = frame.pose.rotation().matrix()
    height_m = float(frame.pose.translation()[2]) - state.terrain.elevation_m(frame.pose.translation())
    shift_m = height_m * (0.02 * r_w_c[:2, 0] - 0.01 * r_w_c[:2, 1])
    assert after.position_m - before.position_m == pytest.approx(shift_m)
    lever = height_m * r_w_c[:2, :2]
    expected = lever @ np.diag([0.003**2, 0.004**2]) @ lever.T
    assert (after.cov - before.cov)[:2, :2] == pytest.approx(expected, abs=0.01)
    assert 0.05 < expected[0, 0] < 0.25
