"""What motion odometry may show, and when a static picture is a frozen camera."""

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


def innovation(off_m: float, dt_s: float = 0.5, *, inertial: bool) -> MotionInnovation:
    return MotionInnovation(np.array([off_m, 0.0, 0.0]), SIGMA_M**2 * np.eye(3), dt_s, inertial)


@pytest.mark.parametrize(("inertial", "manoeuvre_mps2"), [(False, 40.0), (True, 5.0)])
def test_a_motion_is_possible_up_to_the_gate_beyond_the_hardest_manoeuvre(
    inertial: bool, manoeuvre_mps2: float
) -> None:
    limit_m = 0.5 * manoeuvre_mps2 * 0.5**2 + math.sqrt(GATE_D2) * SIGMA_M
    assert innovation(0.99 * limit_m, inertial=inertial).is_possible
    assert not innovation(1.01 * limit_m, inertial=inertial).is_possible


def test_the_gate_refuses_one_true_motion_in_a_million() -> None:
    """Chi-square with 3 degrees of freedom, in closed form."""
    beyond = math.erfc(math.sqrt(GATE_D2 / 2.0)) + math.sqrt(2.0 * GATE_D2 / math.pi) * math.exp(-GATE_D2 / 2.0)
    assert beyond == pytest.approx(1e-6, rel=0.01)


def test_a_motion_within_the_hardest_manoeuvre_is_possible_however_well_it_is_predicted() -> None:
    sure = replace(innovation(0.5, inertial=False), cov_m2=0.01 * np.eye(3))
    assert sure.is_possible and sure.d2(40.0) == 0.0


@pytest.mark.parametrize("inertial", [False, True])
def test_no_manoeuvre_ends_in_a_stand_from_one_frame_to_the_next(inertial: bool) -> None:
    limit_m = math.sqrt(GATE[3]) * SIGMA_M
    assert innovation(0.99 * limit_m, inertial=inertial).may_stand
    assert not innovation(1.01 * limit_m, inertial=inertial).may_stand


def test_a_wide_prediction_bears_a_large_motion() -> None:
    wide = MotionInnovation(np.array([40.0, 0.0, 0.0]), 10.0**2 * np.eye(3), 0.5, True)
    assert wide.is_possible
    assert not replace(wide, cov_m2=np.eye(3)).is_possible


def test_a_vehicle_that_moves_has_a_frozen_camera_until_the_view_changes() -> None:
    guard = StaticPicture()
    assert guard.is_frozen(0.0, FLYING, static=True, moves=True)
    assert guard.is_frozen(0.5, FLYING, static=True, moves=False)  # by now dead reckoning may know too little
    assert not guard.is_frozen(1.0, FLYING, static=False, moves=False)
    assert not guard.is_frozen(1.5, FLYING, static=True, moves=False)


def test_an_attitude_that_moves_under_a_static_picture_is_a_frozen_camera() -> None:
    guard = StaticPicture()
    assert not guard.is_frozen(0.0, FLYING, static=True, moves=False)
    swayed = replace(FLYING, roll_rad=math.radians(1.5))
    assert guard.is_frozen(0.5, swayed, static=True, moves=False)
    pitched = replace(FLYING, pitch_rad=math.radians(-1.5))
    fresh = StaticPicture()
    assert not fresh.is_frozen(0.0, FLYING, static=True, moves=False)
    assert fresh.is_frozen(0.5, pitched, static=True, moves=False)


def test_nothing_in_the_air_stands_still_for_long() -> None:
    guard = StaticPicture()
    swaying = [replace(FLYING, roll_rad=math.radians(0.5 * (i % 2))) for i in range(8)]  # by less than attitudes wander
    said = [guard.is_frozen(0.5 * i, attitude, static=True, moves=False) for i, attitude in enumerate(swaying)]
    assert said == [0.5 * i >= 3.0 for i in range(8)]


def test_a_vehicle_that_stands_on_the_ground_may_see_the_same_view_for_ever() -> None:
    guard, standing = StaticPicture(), Attitude(0.0, 0.0, 0.0, 0.0, armed=False)
    assert not any(guard.is_frozen(float(t), standing, static=True, moves=True) for t in range(60))


def test_attitudes_that_nobody_reports_do_not_tell_of_motion() -> None:
    guard, unknown = StaticPicture(), Attitude(0.0, None, None, 100.0)
    assert not guard.is_frozen(0.0, unknown, static=True, moves=False)
    assert not guard.is_frozen(1.0, unknown, static=True, moves=False)
