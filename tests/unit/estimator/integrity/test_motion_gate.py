"""Innovation gate of odometry, and detection of a frozen camera."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrafix.core.gate import GATE
from terrafix.estimator.integrity.motion_gate import GATE_D2, MotionInnovation
from terrafix.estimator.integrity.static_picture import StaticPicture
from terrafix.estimator.measurements.telemetry_buffer import Attitude

FLYING = Attitude(0.0, 0.0, 0.0, 100.0, armed=True)
SIGMA_M = 0.5


def innovation(residual_m: float, dt_s: float = 0.5, *, inertial: bool) -> MotionInnovation:
    return MotionInnovation(np.array([residual_m, 0.0, 0.0]), SIGMA_M**2 * np.eye(3), dt_s, inertial)


@pytest.mark.parametrize(("inertial", "manoeuvre_mps2"), [(False, 40.0), (True, 5.0)])
def test_a_motion_passes_up_to_the_gate_beyond_the_hardest_manoeuvre(inertial: bool, manoeuvre_mps2: float) -> None:
    limit_m = 0.5 * manoeuvre_mps2 * 0.5**2 + math.sqrt(GATE_D2) * SIGMA_M
    assert innovation(0.99 * limit_m, inertial=inertial).gated.is_accepted
    assert not innovation(1.01 * limit_m, inertial=inertial).gated.is_accepted


def test_the_gate_rejects_one_true_motion_in_a_million() -> None:
    """Chi-square with 3 degrees of freedom, in closed form."""
    beyond = math.erfc(math.sqrt(GATE_D2 / 2.0)) + math.sqrt(2.0 * GATE_D2 / math.pi) * math.exp(-GATE_D2 / 2.0)
    assert beyond == pytest.approx(1e-6, rel=0.01)


def test_a_motion_within_the_hardest_manoeuvre_passes_at_any_covariance() -> None:
    sure = replace(innovation(0.5, inertial=False), cov_m2=0.01 * np.eye(3))
    assert sure.gated.is_accepted and sure.gated.mahalanobis2 == 0.0


@pytest.mark.parametrize("inertial", [False, True])
def test_no_manoeuvre_is_allowed_for_a_standstill(inertial: bool) -> None:
    limit_m = math.sqrt(GATE[3]) * SIGMA_M
    assert innovation(0.99 * limit_m, inertial=inertial).allows_standstill
    assert not innovation(1.01 * limit_m, inertial=inertial).allows_standstill


def test_a_wide_prediction_allows_a_large_motion() -> None:
    wide = MotionInnovation(np.array([40.0, 0.0, 0.0]), 10.0**2 * np.eye(3), 0.5, True)
    assert wide.gated.is_accepted
    assert not replace(wide, cov_m2=np.eye(3)).gated.is_accepted


def test_a_moving_vehicle_with_a_static_picture_is_frozen_until_the_view_changes() -> None:
    detector = StaticPicture()
    assert detector.is_frozen(0.0, FLYING, static=True, is_moving=True)
    assert detector.is_frozen(0.5, FLYING, static=True, is_moving=False)  # also if dead reckoning becomes too uncertain
    assert not detector.is_frozen(1.0, FLYING, static=False, is_moving=False)
    assert not detector.is_frozen(1.5, FLYING, static=True, is_moving=False)


def test_a_tilt_change_under_a_static_picture_is_a_frozen_camera() -> None:
    detector = StaticPicture()
    assert not detector.is_frozen(0.0, FLYING, static=True, is_moving=False)
    swayed = replace(FLYING, roll_rad=math.radians(1.5))
    assert detector.is_frozen(0.5, swayed, static=True, is_moving=False)
    pitched = replace(FLYING, pitch_rad=math.radians(-1.5))
    fresh = StaticPicture()
    assert not fresh.is_frozen(0.0, FLYING, static=True, is_moving=False)
    assert fresh.is_frozen(0.5, pitched, static=True, is_moving=False)


def test_a_static_picture_in_the_air_is_frozen_after_3_s() -> None:
    detector = StaticPicture()
    swaying = [
        replace(FLYING, roll_rad=math.radians(0.5 * (i % 2))) for i in range(8)
    ]  # below the drift of attitude filters
    frozen = [detector.is_frozen(0.5 * i, attitude, static=True, is_moving=False) for i, attitude in enumerate(swaying)]
    assert frozen == [0.5 * i >= 3.0 for i in range(8)]


def test_a_static_picture_on_the_ground_is_not_frozen() -> None:
    detector, standing = StaticPicture(), Attitude(0.0, 0.0, 0.0, 0.0, armed=False)
    assert not any(detector.is_frozen(float(t), standing, static=True, is_moving=True) for t in range(60))


def test_unknown_attitudes_do_not_indicate_a_tilt_change() -> None:
    detector, unknown = StaticPicture(), Attitude(0.0, None, None, 100.0)
    assert not detector.is_frozen(0.0, unknown, static=True, is_moving=False)
    assert not detector.is_frozen(1.0, unknown, static=True, is_moving=False)
