"""Speed prior for dead reckoning: last observed speed, or the former cruise speed."""

import numpy as np
import pytest

from terrafix.estimator.models.motion_model import integrate_motion, predict_covariance
from terrafix.estimator.models.speed_prior import CRUISE_MEMORY_S, TYPICAL_SPEED_MPS, SpeedPrior
from terrafix.estimator.state import MOTION_SIZE

SURE = 0.2**2 * np.eye(3)
CRUISE_MPS, FRAME_S = 14.0, 0.5


def flown(*legs: tuple[float, float], cov: np.ndarray = SURE) -> SpeedPrior:
    """The prior after legs of (duration in s, speed in m/s)."""
    prior, t_s = SpeedPrior(), 0.0
    for duration_s, speed_mps in legs:
        for _ in range(round(duration_s / FRAME_S)):
            t_s += FRAME_S
            prior.update(t_s, np.array([0.0, speed_mps, 0.0]), cov)
    return prior


def test_the_prior_before_flight_is_the_typical_speed() -> None:
    assert SpeedPrior().speed_mps == TYPICAL_SPEED_MPS


def test_the_prior_in_cruise_is_the_observed_speed() -> None:
    assert flown((60.0, CRUISE_MPS)).speed_mps == pytest.approx(CRUISE_MPS, abs=0.1)


def test_the_cruise_speed_persists_in_a_hover_and_decays() -> None:
    assert flown((60.0, CRUISE_MPS), (10.0, 0.0)).speed_mps > 0.9 * CRUISE_MPS
    assert flown((60.0, CRUISE_MPS), (3.0 * CRUISE_MEMORY_S, 0.0)).speed_mps < 1.0


def test_an_uncertain_velocity_does_not_raise_the_cruise_speed() -> None:
    prior = flown((5.0, 0.0), cov=15.0**2 * np.eye(3))
    assert prior.speed_mps > 20.0  # while it is uncertain
    prior.update(5.0 + FRAME_S, np.zeros(3), SURE)
    assert prior.speed_mps <= TYPICAL_SPEED_MPS


def test_repeated_updates_at_one_time_decay_the_cruise_speed_once() -> None:
    prior = flown((60.0, CRUISE_MPS))
    for _ in range(1000):
        prior.update(60.0, np.zeros(3), SURE)
    assert prior.speed_mps > 0.9 * CRUISE_MPS


def test_the_first_map_match_is_ignored_and_the_second_is_used() -> None:
    prior = SpeedPrior()
    prior.update_by_map(0.0, np.zeros(3), 15.0**2 * np.eye(3))
    assert prior.speed_mps == TYPICAL_SPEED_MPS
    prior.update_by_map(5.0, np.array([0.0, 20.0, 0.0]), 3.0**2 * np.eye(3))
    assert prior.speed_mps > 20.0


def test_a_departure_from_hover_without_pictures_is_within_the_covariance() -> None:
    """Twenty seconds without a picture, flown at cruising speed: 280 m."""
    prior = flown((60.0, CRUISE_MPS), (5.0, 0.0))
    unseen_s = 20.0
    increment = integrate_motion(unseen_s, None, (0.0, 0.0), 0.0, prior.speed_mps, 0.03, same_source=True)
    sigma_m = float(np.sqrt(predict_covariance(increment, 0.1 * np.eye(MOTION_SIZE))[1, 1]))
    assert CRUISE_MPS * unseen_s < 3.5 * sigma_m < 2.0 * CRUISE_MPS * unseen_s
