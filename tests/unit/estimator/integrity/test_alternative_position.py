"""Alternative position: its part of the covariance while matches and graph disagree, and after a switch."""

import numpy as np
import pytest

from terrafix.core.gate import MIN_COMPONENT_WEIGHT
from terrafix.estimator.integrity.alternative_position import REACHED_PROBABILITY, AlternativePosition

ESTIMATE_COV = np.diag([4.0, 4.0, 9.0, 1e-4, 1e-4, 1e-4])
OFFSET_COV = np.diag([16.0, 25.0])  # covariance of the offset between estimate and match
FRAME = 7  # of a match


def log_odds(probability: float) -> float:
    """Nats that lead from even odds to ``probability``."""
    return float(np.log(probability / (1.0 - probability)))


def mahalanobis2(cov: np.ndarray, error_m: np.ndarray) -> float:
    return float(error_m @ np.linalg.solve(cov[:2, :2], error_m))


def inflated(other: AlternativePosition, cov: np.ndarray) -> np.ndarray:
    """``cov`` (6, 6) with the inflation by the alternative position."""
    cov = cov.copy()
    cov[:2, :2] += other.moments_m2()
    return cov


def test_a_single_rejected_match_does_not_spawn_an_alternative_position() -> None:
    other = AlternativePosition()
    other.spawn([np.array([350.0, 0.0])], OFFSET_COV)
    assert np.array_equal(inflated(other, ESTIMATE_COV), ESTIMATE_COV)


def test_two_consistent_rejected_matches_extend_the_ellipse_to_the_alternative_position_only() -> None:
    other, offset = AlternativePosition(), np.array([60.0, -30.0])
    other.spawn([offset + 1.0, offset - 1.0], OFFSET_COV)
    cov = inflated(other, ESTIMATE_COV)
    assert mahalanobis2(cov, offset) < 5.991
    across = np.array([30.0, 60.0])
    assert mahalanobis2(cov, across) > 50.0
    assert np.array_equal(cov[2:], ESTIMATE_COV[2:])


def switched(offset_m: np.ndarray, first_frame: int = 0) -> AlternativePosition:
    """After two matches at ``offset_m`` that agree."""
    other = AlternativePosition()
    other.spawn([offset_m, offset_m], OFFSET_COV, first_frame)
    other.switch(offset_m, OFFSET_COV, first_frame)
    return other


def test_after_a_switch_the_old_position_stays_until_images_fit_worse_there() -> None:
    offset = np.array([0.0, 80.0])
    other = switched(offset)
    for nats in (None, 0.0, -1.0, -1.0):
        assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
        other.on_match(FRAME, nats)
    other.on_match(FRAME, -1.0)
    assert np.array_equal(inflated(other, ESTIMATE_COV), ESTIMATE_COV)


def test_images_that_fit_better_at_the_alternative_make_it_as_probable_as_the_estimate_and_no_more() -> None:
    other = switched(np.array([0.0, 80.0]))
    other.on_match(FRAME, -2.0)
    assert other.weight == pytest.approx(1.0 / (1.0 + np.exp(2.0)))
    other.on_match(FRAME, 1.0)
    assert other.weight == pytest.approx(1.0 / (1.0 + np.e))
    other.on_match(FRAME, 3.0)
    assert other.weight == 0.5


def test_frames_that_were_compared_with_an_earlier_alternative_do_not_count() -> None:
    other = switched(np.array([0.0, 80.0]), first_frame=FRAME)
    other.on_match(FRAME - 1, -2.0)
    assert other.weight == 0.5
    other.on_match(FRAME, -2.0)
    assert other.weight < 0.5


def test_an_alternative_that_images_have_excluded_does_not_return_by_them() -> None:
    other = switched(np.array([0.0, 80.0]))
    other.on_match(FRAME, 1.1 * log_odds(MIN_COMPONENT_WEIGHT))
    assert other.weight == 0.0


def test_the_alternative_position_has_the_covariance_of_its_offset() -> None:
    """A plane without IMU had drifted by 8 m at the switch, and the old position lay aside of the offset."""
    other, offset = AlternativePosition(), np.array([-75.0, -3.0])
    other.switch(offset, OFFSET_COV)
    aside = -offset + np.array([3.0, 7.0])
    assert mahalanobis2(inflated(other, ESTIMATE_COV), aside) < 9.0
    sure = AlternativePosition()
    sure.switch(offset, 0.0 * OFFSET_COV)
    assert mahalanobis2(inflated(sure, ESTIMATE_COV), aside) > 9.0


def test_below_the_reached_probability_the_offset_covariance_is_scaled_down() -> None:
    other, offset = AlternativePosition(), np.array([60.0, 0.0])
    other.switch(offset, OFFSET_COV)
    other.on_match(FRAME, log_odds(REACHED_PROBABILITY) + 0.01)
    assert other.moments_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1])
    other.on_match(FRAME, log_odds(0.06) - log_odds(REACHED_PROBABILITY) - 0.01)
    assert other.moments_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1] * 0.06 / REACHED_PROBABILITY)
