"""Lock monitor: bounds of its log odds, and which positions it does not test."""

import math

import pytest

from terrafix.anchor.verification.lock_monitor import (
    LOCK_NULL_GAIN,
    MAX_GAIN,
    MAX_LOG_ODDS,
    MIN_GAIN,
    START_LOG_ODDS,
    LockMonitor,
    has_wide_sigma,
    pose_gain,
)
from terrafix.core.agreement import Cause

AGL_M, SIGMA_M = 100.0, 5.0


def with_odds(log_odds: float) -> LockMonitor:
    monitor = LockMonitor()
    monitor.agreement.begin(Cause.ELSEWHERE, -log_odds)
    return monitor


def observed(gain: float, *, weight: float = 1.0, new: float = 1.0, inliers: int = 0) -> float:
    """Change of the log odds by one observation."""
    monitor = LockMonitor()
    monitor.update(gain, weight, new, inliers, SIGMA_M, AGL_M)
    return monitor.log_odds - START_LOG_ODDS


@pytest.mark.parametrize(
    ("sigma_m", "agl_m", "wide"),
    [(39.0, 40.0, False), (41.0, 40.0, True), (99.0, 200.0, False), (101.0, 200.0, True), (41.0, 200.0, False)],
)
def test_a_sigma_is_wide_above_both_forty_metres_and_half_the_height(sigma_m: float, agl_m: float, wide: bool) -> None:
    assert has_wide_sigma(sigma_m, agl_m) is wide


@pytest.mark.parametrize(
    ("inliers", "nats"), [(0, 0.0), (7, 0.0), (8, 3.0), (11, 3.0), (12, 5.0), (19, 5.0), (20, 6.0), (300, 6.0)]
)
def test_more_inliers_are_more_evidence(inliers: int, nats: float) -> None:
    assert pose_gain(inliers) == nats


def test_an_observation_counts_by_its_gain_above_the_null_hypothesis_within_bounds() -> None:
    assert observed(LOCK_NULL_GAIN + 0.7) == pytest.approx(0.7)
    assert observed(LOCK_NULL_GAIN - 0.2) == pytest.approx(-0.2)
    assert observed(90.0) == pytest.approx(MAX_GAIN) == 2.0
    assert observed(-90.0) == pytest.approx(MIN_GAIN) == -0.4


def test_the_bounds_are_those_of_the_share_that_is_observed() -> None:
    assert observed(90.0, weight=0.25) == pytest.approx(0.25 * MAX_GAIN)
    assert observed(-90.0, weight=0.25, new=0.1) == pytest.approx(0.1 * MIN_GAIN)
    assert observed(0.25 * LOCK_NULL_GAIN, weight=0.25, new=0.1) == pytest.approx(0.0)


def test_a_pose_counts_by_the_weight_of_its_observation() -> None:
    assert observed(LOCK_NULL_GAIN, inliers=20) == pytest.approx(6.0)
    assert observed(0.5 * LOCK_NULL_GAIN, weight=0.5, inliers=20) == pytest.approx(3.0)


def test_a_start_outweighs_fourteen_full_observations_without_evidence_and_not_sixteen() -> None:
    monitor, lost = LockMonitor(), []
    for _ in range(16):
        monitor.update(0.0, 1.0, 1.0, 0, SIGMA_M, AGL_M)
        lost.append(monitor.lost)
    assert not any(lost[:14]) and lost[15]


def test_the_log_odds_are_bounded_so_that_a_lock_can_be_lost_again() -> None:
    monitor = LockMonitor()
    for _ in range(40):
        monitor.update(9.0, 1.0, 1.0, 30, SIGMA_M, AGL_M)
    assert monitor.log_odds == MAX_LOG_ODDS == 20.0


def test_nothing_counts_against_a_position_with_a_wide_sigma_that_has_the_odds_of_a_start_at_most() -> None:
    sure, doubted = with_odds(MAX_LOG_ODDS), with_odds(1.0)
    for monitor in (sure, doubted):
        monitor.update(-5.0, 1.0, 1.0, 0, 60.0, AGL_M)
    assert (sure.log_odds, doubted.log_odds) == (START_LOG_ODDS, 1.0)


def test_evidence_and_poses_end_a_doubt_from_before_the_sigma_was_wide() -> None:
    monitor = with_odds(1.0)
    monitor.update(4.5, 1.0, 1.0, 0, 60.0, AGL_M)
    assert monitor.log_odds == pytest.approx(2.5) and monitor.wrong_probability > 0.0
    monitor.update(-5.0, 1.0, 1.0, 8, 60.0, AGL_M)
    assert monitor.log_odds == pytest.approx(5.5) and monitor.wrong_probability == 0.0
    monitor.update(4.5, 1.0, 1.0, 0, 60.0, AGL_M)
    assert monitor.log_odds == START_LOG_ODDS


@pytest.mark.parametrize(
    ("log_odds", "wrong", "lost"),
    [
        (20.0, 0.0, False),
        (math.log(0.95 / 0.05) + 0.01, 0.0, False),
        (math.log(0.95 / 0.05) - 0.01, 0.05, False),
        (2.0, 0.119, False),
        (0.0, 0.5, False),
        (-1.0, 0.731, True),
    ],
)
def test_the_wrong_probability_follows_the_odds_below_those_of_five_per_cent(
    log_odds: float, wrong: float, lost: bool
) -> None:
    monitor = with_odds(log_odds)
    assert monitor.wrong_probability == pytest.approx(wrong, abs=1e-3)
    assert monitor.lost is lost
