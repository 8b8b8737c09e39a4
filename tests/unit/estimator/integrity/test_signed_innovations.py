"""Odometry innovations that keep one sign are an alarm, noise is none."""

import numpy as np
import pytest

from terrafix.estimator.integrity.signed_innovations import SHIFT, SignedInnovations

COV_M2 = np.diag([0.64, 1.0])


def test_an_hour_of_noise_is_no_alarm() -> None:
    test, rng = SignedInnovations(), np.random.default_rng(4)
    for residual_m in rng.normal(0.0, [0.8, 1.0], (36_000, 2)):
        test.add(residual_m, COV_M2)
        assert not test.alarm


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_metres_to_one_side_in_each_frame_are_an_alarm_within_four_frames(axis: int, sign: float) -> None:
    test, residual_m = SignedInnovations(), np.zeros(2)
    residual_m[axis] = sign * 3.0
    frames = 0
    while not test.alarm:
        test.add(residual_m, COV_M2)
        frames += 1
    assert frames == 4
    assert test.sum_m[axis] == pytest.approx(sign * 12.0)  # as far as the estimate has followed


def test_as_many_metres_to_both_sides_are_none() -> None:
    test = SignedInnovations()
    for i in range(200):
        test.add(np.array([0.0, 3.0 * (-1.0) ** i]), COV_M2)
        assert not test.alarm


def test_the_sum_is_that_of_the_run_alone() -> None:
    test = SignedInnovations()
    for _ in range(50):
        test.add(np.array([0.3, 0.0]), COV_M2)  # a bias below half of what is tested
    assert not test.alarm and not test.sum_m.any()
    test.add(np.array([0.0, 2.0 * SHIFT]), COV_M2)
    assert test.sum_m.tolist() == [0.0, 2.0 * SHIFT]
