"""Linearization cache of custom factors: equal values give the cached result, others are computed."""

from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, C

from terrafix.estimator.factors import linearization_cache
from terrafix.estimator.factors.linearization_cache import MAX_ENTRIES, custom_factor


class Counted:
    """Error height + offset - measured, with a count of its linearizations."""

    def __init__(self, measured_m: float) -> None:
        self.measured_m, self.times = measured_m, 0

    def error(self, _this: Any, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        pose, offset = values.atPose3(C(0)), values.atVector(B(0))
        if jacobians is not None:
            self.times += 1
            jacobians[0] = np.array([[0.0, 0.0, 0.0, *pose.rotation().matrix()[2]]], order="F")
            jacobians[1] = np.array([[1.0]], order="F")
        return np.array([pose.translation()[2] + offset[0] - self.measured_m])

    def factor(self) -> gtsam.CustomFactor:
        return custom_factor(gtsam.noiseModel.Unit.Create(1), [C(0), B(0)], self.error)


def around(up_m: float, offset_m: float, tilt_rad: float = 0.0) -> gtsam.Values:
    values = gtsam.Values()
    values.insert(C(0), gtsam.Pose3(gtsam.Rot3.Rx(tilt_rad), np.array([1.0, 2.0, up_m])))
    values.insert(B(0), np.array([offset_m]))
    return values


def linearized(factor: gtsam.CustomFactor, values: gtsam.Values) -> np.ndarray:
    return np.asarray(factor.linearize(values).augmentedJacobian())


def test_equal_values_use_the_cached_linearization_and_others_are_computed() -> None:
    counted = Counted(50.0)
    factor = counted.factor()
    for up_m, offset_m, tilt_rad, times in ((60.0, 1.0, 0.0, 1), (60.0, 1.0, 0.0, 1), (60.0, 1.5, 0.0, 2),
                                            (61.0, 1.5, 0.0, 3), (61.0, 1.5, 0.3, 4), (60.0, 1.0, 0.0, 5)):  # fmt: skip
        values = around(up_m, offset_m, tilt_rad)
        up = np.array([0.0, np.sin(tilt_rad), np.cos(tilt_rad)])
        np.testing.assert_allclose(linearized(factor, values), [[0.0, 0.0, 0.0, *up, 1.0, 50.0 - up_m - offset_m]])
        assert counted.times == times
        assert factor.error(values) == 0.5 * (up_m + offset_m - 50.0) ** 2


def test_each_factor_has_its_own_entry_and_the_cache_is_bounded() -> None:
    all_counted = [Counted(float(i)) for i in range(MAX_ENTRIES + 10)]
    factors = [counted.factor() for counted in all_counted]
    for _ in range(2):
        for i, factor in enumerate(factors):
            assert linearized(factor, around(60.0, 0.0))[0, -1] == i - 60.0
    assert len(linearization_cache._cache) == MAX_ENTRIES
    assert linearized(factors[-1], around(60.0, 0.0))[0, -1] == len(factors) - 61.0
    assert [counted.times for counted in all_counted] == [2] * len(factors)
