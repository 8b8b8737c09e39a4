"""An estimator that was killed in flight: the next one begins where it left off, as sure as that allows."""

import math

import numpy as np
import pytest

from simulated_flight import (
    FRAME_S,
    ORIGIN,
    SPEED_MPS,
    EstimatorRun,
    Flight,
    blind,
    error_m,
    same_features,
    sigma_m,
    some_features,
)
from terrafix.core.geodesy import rot_from_quat
from terrafix.core.pose import log_so3
from terrafix.estimator.node import EstimatorNode
from terrafix.estimator.prior import CalibrationPrior, EstimatorCheckpoint, NavPrior, load_checkpoint
from terrafix.messages import MeasurementVerdict, Odometry, Prediction, VehicleState, Verdict

KILLED, BACK = 60, 66  # frames: three seconds
PLANE_MPS, DOWN_S, BANK_DEG = 22.0, 7.0, 42.0


@pytest.fixture(scope="module")
def flight() -> Flight:
    return Flight(90, seed=6, dem=True)


@pytest.fixture(scope="module")
def killed(flight: Flight, tmp_path_factory: pytest.TempPathFactory) -> EstimatorCheckpoint:
    folder = tmp_path_factory.mktemp("run")
    assert load_checkpoint(folder / "estimator.checkpoint") is None
    last = EstimatorRun().checkpoint(flight, KILLED, folder)
    assert last is not None and last.estimate.frame_id == KILLED - 1
    return last


def resumed(flight: Flight, last: EstimatorCheckpoint | None) -> EstimatorRun:
    run = EstimatorRun()
    run.node = EstimatorNode(0, last)
    run.feed([ORIGIN])
    for i in range(BACK, flight.frames):
        messages = flight.messages(i)
        if i == BACK:  # its keyframe is not known to this one
            messages = [blind(m) if isinstance(m, Odometry) else m for m in messages]
        run.feed(messages)
    return run


def test_it_goes_on_from_there(flight: Flight, killed: EstimatorCheckpoint) -> None:
    run = resumed(flight, killed)
    first = run.estimate(BACK)
    assert np.linalg.norm(error_m(first, flight)[:2]) < 25.0
    assert sigma_m(killed.estimate) < sigma_m(first) < 40.0
    for i in range(BACK, flight.frames):
        estimate = run.estimate(i)
        assert np.linalg.norm(error_m(estimate, flight)[:2]) < 3.5 * np.sqrt(2.0) * sigma_m(estimate)
    assert sigma_m(run.estimate(flight.frames - 1)) < 10.0


def test_the_prediction_has_the_step_since_the_checkpoint(flight: Flight, killed: EstimatorCheckpoint) -> None:
    prediction = next(m for m in resumed(flight, killed).published if isinstance(m, Prediction))
    flown_m = flight.p_m[BACK, :2] - flight.p_m[KILLED - 1, :2]
    assert np.linalg.norm(prediction.step_m - flown_m) < 20.0 < np.linalg.norm(flown_m)


def test_without_what_it_left_it_knows_the_start_only(flight: Flight) -> None:
    """Half a minute ago, and so it claims little."""
    first = resumed(flight, None).estimate(BACK)
    assert sigma_m(first) > 0.5 * SPEED_MPS * FRAME_S * BACK


def heading_and_scale_sigma(run: EstimatorRun) -> tuple[float, float]:
    """Of the first Prediction: what the anchor has to look through."""
    first = next(m for m in run.published if isinstance(m, Prediction))
    return float(np.sqrt(first.cov[35])), first.agl_sigma_m / first.agl_m


def test_what_was_learnt_of_compass_and_barometer_holds_on(flight: Flight, killed: EstimatorCheckpoint) -> None:
    assert killed.calibration is not None and killed.estimate.t_ns - killed.calibration.t_ns < 1_500_000_000
    with_it = heading_and_scale_sigma(resumed(flight, killed))
    without = heading_and_scale_sigma(resumed(flight, EstimatorCheckpoint(killed.estimate, ground=killed.ground)))
    assert with_it[0] < 0.6 * without[0] and with_it[1] <= without[1]
    # And it was learnt right: the heading that is begun with is no farther off than it claims.
    first = resumed(flight, killed).estimate(BACK)
    turned = rot_from_quat(first.q_w_b) @ flight.r_w_b[BACK].T
    assert abs(log_so3(turned)[2]) < 3.0 * with_it[0]


def test_frames_wait_for_the_words_to_which_belongs_what_was_learnt(
    flight: Flight, killed: EstimatorCheckpoint
) -> None:
    """Vision is there before the link: a graph that began blind would begin anew, and lose its keyframe."""
    node = EstimatorNode(0, killed)
    messages = list(node.on(ORIGIN))
    frames = [next(m for m in flight.messages(i) if isinstance(m, Odometry)) for i in (BACK, BACK + 1)]
    frames[0] = blind(frames[0])
    for odometry in frames:
        messages += node.on(odometry)
    assert not messages
    words = [m for i in (BACK, BACK + 1) for m in flight.messages(i) if isinstance(m, VehicleState)]
    for message in words:
        messages += node.on(message)
    first = next(m for m in messages if isinstance(m, Prediction))
    assert first.frame_id == BACK and np.sqrt(first.cov[35]) < 0.1
    assert sum(isinstance(m, Prediction) for m in messages) == 2


def test_a_picture_that_is_older_than_the_first_words_is_not_begun_with(
    flight: Flight, killed: EstimatorCheckpoint
) -> None:
    """A camera has buffers. Begun with it, the graph was blind, and the anchor looked at all headings for 8 s."""
    node = EstimatorNode(0, killed)
    messages = list(node.on(ORIGIN))
    old, new = BACK, BACK + 4  # two seconds
    for message in [m for m in flight.messages(new) if isinstance(m, VehicleState)]:
        messages += node.on(message)
    for i in (old, new, new + 1):
        messages += [x for m in flight.messages(i) if isinstance(m, Odometry) for x in node.on(blind(m))]
    predictions = [m for m in messages if isinstance(m, Prediction)]
    assert [m.frame_id for m in predictions] == [new, new + 1]
    verdicts = {m.frame_id: m.verdict for m in messages if isinstance(m, MeasurementVerdict)}
    assert verdicts.pop(old) is Verdict.STALE and sorted(verdicts) == [new, new + 1]
    assert np.sqrt(predictions[0].cov[35]) < 0.1


def test_odometry_against_a_picture_that_was_left_out_is_not_lost(flight: Flight, killed: EstimatorCheckpoint) -> None:
    """It is the keyframe of the pictures after it, for up to five seconds where a vehicle is slow."""
    old, new, features = BACK, BACK + 4, some_features()
    node = EstimatorNode(0, killed)
    messages = list(node.on(ORIGIN))
    messages += node.on(blind(next(m for m in flight.messages(old) if isinstance(m, Odometry))))
    for i in (new, new + 1, new + 2):
        for message in [m for m in flight.messages(i) if isinstance(m, VehicleState)]:
            messages += node.on(message)
        messages += node.on(same_features(flight, old, i, features[5 * (i - new) :]))  # no two show the same of them
    odometry_verdicts = [m for m in messages if isinstance(m, MeasurementVerdict) and m.measurement == "odometry"]
    verdicts = {m.frame_id: m.verdict for m in odometry_verdicts}
    assert verdicts == {old: Verdict.STALE} | dict.fromkeys((new, new + 1, new + 2), Verdict.ACCEPTED)
    predictions = [m for m in messages if isinstance(m, Prediction)]
    for i, step in ((new + 1, predictions[1]), (new + 2, predictions[2])):
        flown_m = flight.p_m[i, :2] - flight.p_m[i - 1, :2]
        assert np.linalg.norm(step.step_m - flown_m) < 1.5 < 0.5 * np.linalg.norm(flown_m)


def test_an_autopilot_without_telemetry_is_not_waited_for(flight: Flight, killed: EstimatorCheckpoint) -> None:
    node = EstimatorNode(0, killed)
    messages = list(node.on(ORIGIN))
    for i in range(BACK, BACK + 5):
        messages += [x for m in flight.messages(i) if isinstance(m, Odometry) for x in node.on(blind(m))]
    assert sum(isinstance(m, Prediction) for m in messages) >= 4


def flown_on(turned_deg: float, from_s: float) -> np.ndarray:
    """Way (2,) of a plane that heads east, banks after ``from_s``, and has turned to the left by so much in the end."""
    rate = math.copysign(9.81 * math.tan(math.radians(BANK_DEG)) / PLANE_MPS, turned_deg)
    t = np.linspace(0.0, DOWN_S, 2001)
    course = np.sign(rate) * np.clip(abs(rate) * (t - from_s), 0.0, math.radians(abs(turned_deg)))
    return PLANE_MPS * np.trapezoid([np.cos(course), np.sin(course)], t)


def plane(heads_rad: float = math.radians(90.0), learnt: CalibrationPrior | None = None) -> NavPrior:
    """Flies east."""
    return NavPrior(0.0, np.zeros(2), 5.0, np.array([PLANE_MPS, 0.0]), 0.4, heads_rad, learnt)


@pytest.mark.parametrize("turned_deg", [-110.0, -40.0, 90.0, 110.0])
@pytest.mark.parametrize("from_s", [0.0, 2.0])
def test_a_turn_that_nobody_saw_is_in_the_heading_after_it(turned_deg: float, from_s: float) -> None:
    """A plane that was killed in a bank of 42 degrees was 140 m from where it would have been straight on."""
    way_m, sigma_m = plane().path_until(DOWN_S, math.radians(90.0 - turned_deg))
    true_m = flown_on(turned_deg, from_s)
    off_m, straight_m = np.linalg.norm(way_m - true_m), np.linalg.norm([PLANE_MPS * DOWN_S, 0.0] - true_m)
    assert off_m < 2.0 * sigma_m and sigma_m < 60.0
    assert off_m < 0.5 * straight_m


def test_who_heads_as_before_flew_straight_on() -> None:
    way_m, sigma_m = plane().path_until(DOWN_S, math.radians(90.0))
    assert way_m == pytest.approx([PLANE_MPS * DOWN_S, 0.0], abs=0.1)
    forgotten_m, wider_m = plane().path_until(DOWN_S, None)
    assert forgotten_m[0] < 0.9 * way_m[0] and forgotten_m[1] == 0.0
    assert wider_m == pytest.approx(sigma_m, rel=0.1)
    long_m, long_sigma_m = plane().path_until(60.0, math.radians(90.0))
    back_m, _ = plane().path_until(60.0, None)
    assert long_m[0] - back_m[0] < 2.0 * long_sigma_m  # it may have turned away and back


def test_a_compass_that_is_off_as_it_was_learnt_has_not_turned() -> None:
    off_rad = math.radians(8.0)
    learnt = CalibrationPrior(0.0, np.array([0.0, 0.0, off_rad, 0.0, 0.0, 0.0]), np.eye(6))
    way_m, _ = plane(learnt=learnt).path_until(DOWN_S, math.radians(90.0) + off_rad)
    assert way_m == pytest.approx([PLANE_MPS * DOWN_S, 0.0], abs=0.1)


def test_the_heading_of_a_copter_that_flies_sideways_is_no_course() -> None:
    sideways = plane(heads_rad=0.0)
    assert np.array_equal(sideways.path_until(DOWN_S, 1.0)[0], sideways.path_until(DOWN_S, None)[0])
    hovers = NavPrior(0.0, np.zeros(2), 5.0, np.array([1.0, 0.0]), 0.4, math.radians(90.0))
    assert np.array_equal(hovers.path_until(DOWN_S, 0.0)[0], hovers.path_until(DOWN_S, None)[0])
