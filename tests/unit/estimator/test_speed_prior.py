"""How fast a flight may go on unseen: as it was seen last, or as it cruised before."""

import numpy as np
import pytest

from terrafix.estimator.models.motion_model import V_SIZE, integrate_motion, spread_after
from terrafix.estimator.models.speed_prior import CRUISE_S, TYPICAL_SPEED_MPS, SpeedPrior

SURE = 0.2**2 * np.eye(3)
CRUISE_MPS, FRAME_S = 14.0, 0.5


def flown(*legs: tuple[float, float], cov: np.ndarray = SURE) -> SpeedPrior:
    """Legs of so many seconds at a speed."""
    pace, t_s = SpeedPrior(), 0.0
    for duration_s, speed_mps in legs:
        for _ in range(round(duration_s / FRAME_S)):
            t_s += FRAME_S
            pace.seen(t_s, np.array([0.0, speed_mps, 0.0]), cov)
    return pace


def test_one_that_has_not_flown_may_fly_as_drones_do() -> None:
    assert SpeedPrior().mps == TYPICAL_SPEED_MPS


def test_one_that_cruises_is_as_fast_as_it_is_seen() -> None:
    assert flown((60.0, CRUISE_MPS)).mps == pytest.approx(CRUISE_MPS, abs=0.1)


def test_one_that_hovers_may_fly_on_and_is_forgotten_to_have_flown() -> None:
    assert flown((60.0, CRUISE_MPS), (10.0, 0.0)).mps > 0.9 * CRUISE_MPS
    assert flown((60.0, CRUISE_MPS), (3.0 * CRUISE_S, 0.0)).mps < 1.0


def test_a_velocity_that_is_not_known_is_not_remembered() -> None:
    pace = flown((5.0, 0.0), cov=15.0**2 * np.eye(3))
    assert pace.mps > 20.0  # as long as it is not known
    pace.seen(5.0 + FRAME_S, np.zeros(3), SURE)
    assert pace.mps <= TYPICAL_SPEED_MPS


def test_a_frame_that_is_told_twice_is_forgotten_once() -> None:
    pace = flown((60.0, CRUISE_MPS))
    for _ in range(1000):
        pace.seen(60.0, np.zeros(3), SURE)
    assert pace.mps > 0.9 * CRUISE_MPS


def test_a_first_fix_tells_no_pace_and_two_do() -> None:
    pace = SpeedPrior()
    pace.fixed(0.0, np.zeros(3), 15.0**2 * np.eye(3))
    assert pace.mps == TYPICAL_SPEED_MPS
    pace.fixed(5.0, np.array([0.0, 20.0, 0.0]), 3.0**2 * np.eye(3))
    assert pace.mps > 20.0


def test_a_hover_that_ends_unseen_is_inside_the_claim() -> None:
    """Twenty seconds without a picture, flown at cruising speed: 280 m."""
    pace = flown((60.0, CRUISE_MPS), (5.0, 0.0))
    unseen_s = 20.0
    way = integrate_motion(unseen_s, None, (0.0, 0.0), 0.0, pace.mps, 0.03, same_kind=True)
    sigma_m = float(np.sqrt(spread_after(way, 0.1 * np.eye(V_SIZE))[1, 1]))
    assert CRUISE_MPS * unseen_s < 3.5 * sigma_m < 2.0 * CRUISE_MPS * unseen_s
