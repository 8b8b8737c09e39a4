"""Odometry innovations that keep one sign are an alarm, noise and outliers are none."""

import numpy as np
import pytest

from terrafix.estimator.integrity.signed_innovations import RUN_SIZE, SignedInnovations

COV_M2 = np.array([[0.64, 0.2], [0.2, 1.0]])


def test_an_hour_of_noise_is_an_alarm_at_most_once() -> None:
    test, rng, alarms = SignedInnovations(), np.random.default_rng(4), 0
    for residual_m in rng.multivariate_normal(np.zeros(2), COV_M2, 36_000):
        was_alarm = test.alarm
        test.add(residual_m, COV_M2, inertial=False)
        alarms += test.alarm and not was_alarm
    assert alarms <= 1


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_metres_to_one_side_in_each_frame_are_an_alarm_within_three_frames(axis: int, sign: float) -> None:
    test, residual_m = SignedInnovations(), np.zeros(2)
    residual_m[axis] = sign * 3.5
    frames = 0
    while not test.alarm:
        test.add(residual_m, COV_M2, inertial=False)
        frames += 1
    assert 2 <= frames <= 3
    assert test.sum_m[axis] == pytest.approx(frames * sign * 3.5)  # as far as the estimate has followed
    assert test.run == frames


def test_a_small_shift_is_an_alarm_within_the_longest_run() -> None:
    test, shift_m = SignedInnovations(), np.linalg.cholesky(COV_M2) @ [2.3, 0.0]
    for _ in range(RUN_SIZE):
        test.add(shift_m, COV_M2, inertial=False)
    assert test.alarm


def test_as_many_metres_to_both_sides_are_none() -> None:
    test = SignedInnovations()
    for i in range(200):
        test.add(np.array([0.0, 3.0 * (-1.0) ** i]), COV_M2, inertial=False)
        assert not test.alarm


def test_one_outlier_is_none_however_large() -> None:
    test = SignedInnovations()
    for residual_m in ([0.5, 0.0], [1000.0, 0.0], [0.5, 0.0], [0.0, 0.0]):
        test.add(np.array(residual_m), COV_M2, inertial=False)
        assert not test.alarm


def test_the_sum_is_that_of_the_run_alone() -> None:
    test = SignedInnovations()
    for residual_m in ([0.3, 0.0],) * 10 + ([0.0, 3.0], [0.0, 2.0]):
        test.add(np.array(residual_m), COV_M2, inertial=False)
    assert test.sum_m.tolist() == [0.0, 5.0]
    assert test.run == 2


@pytest.mark.parametrize("inertial", [True, False])
def test_what_claims_have_in_common_is_learnt_from_predictions_by_inertial_readings_alone(inertial: bool) -> None:
    """Noise of half the claimed sigma, then a shift that is below the limit of the claimed one."""
    test, rng = SignedInnovations(), np.random.default_rng(5)
    for residual_m in rng.multivariate_normal(np.zeros(2), 0.25 * COV_M2, 200):
        test.add(residual_m, COV_M2, inertial=inertial)
        assert not test.alarm
    shift_m = np.linalg.cholesky(COV_M2) @ [2.7, 0.0]
    for _ in range(3):
        test.add(shift_m, COV_M2, inertial=inertial)
    assert test.alarm == inertial
    test.forget()
    assert not test.alarm
    test.add(shift_m, COV_M2, inertial=inertial)
    assert test.sum_m.tolist() == shift_m.tolist()
