"""Alternative position: its part of the covariance while matches and graph disagree, and after a switch."""

import numpy as np
import pytest

from terrafix.core.agreement import PATTERN_HEIGHTS
from terrafix.estimator.integrity.alternative_position import (
    REACHED_PROBABILITY,
    SHARE_MAPPED,
    SHARE_START,
    AlternativePosition,
)

ESTIMATE_COV = np.diag([4.0, 4.0, 9.0, 1e-4, 1e-4, 1e-4])
NO_MASS = 0.0  # of the belief in the mode of the pose: no effect
OFFSET_COV = np.diag([16.0, 25.0])  # covariance of the offset between estimate and match


def heights_to(probability: float) -> float:
    """New ground after which even odds have fallen to ``probability``."""
    return PATTERN_HEIGHTS * float(np.log(1.0 / probability - 1.0))


def mahalanobis2(cov: np.ndarray, error_m: np.ndarray) -> float:
    return float(error_m @ np.linalg.solve(cov[:2, :2], error_m))


def inflated(other: AlternativePosition, cov: np.ndarray) -> np.ndarray:
    """``cov`` (6, 6) with the inflation by the alternative position."""
    cov = cov.copy()
    cov[:2, :2] += other.moments_m2()
    return cov


def test_a_single_rejected_match_does_not_spawn_an_alternative_position() -> None:
    other = AlternativePosition()
    other.spawn([np.array([350.0, 0.0])], OFFSET_COV, fixed=True)
    assert np.array_equal(inflated(other, ESTIMATE_COV), ESTIMATE_COV)


def test_two_consistent_rejected_matches_extend_the_ellipse_to_the_alternative_position_only() -> None:
    other, offset = AlternativePosition(), np.array([60.0, -30.0])
    other.spawn([offset + 1.0, offset - 1.0], OFFSET_COV, fixed=True)
    cov = inflated(other, ESTIMATE_COV)
    assert mahalanobis2(cov, offset) < 5.991
    across = np.array([30.0, 60.0])
    assert mahalanobis2(cov, across) > 50.0
    assert np.array_equal(cov[2:], ESTIMATE_COV[2:])


def test_after_a_switch_the_old_position_decays_over_new_ground() -> None:
    other, offset = AlternativePosition(), np.array([0.0, 80.0])
    other.switch(offset, OFFSET_COV)
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
    other.on_pose(0.0, NO_MASS)  # without new ground there is no decay
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
    for _ in range(10):
        other.on_pose(0.4 * PATTERN_HEIGHTS / 10, NO_MASS)
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
    other.on_pose(5.0 * PATTERN_HEIGHTS, NO_MASS)
    assert np.array_equal(inflated(other, ESTIMATE_COV), ESTIMATE_COV)


def test_the_alternative_position_has_the_covariance_of_its_offset() -> None:
    """A plane without IMU had drifted by 8 m at the switch, and the old position lay aside of the offset."""
    other, offset = AlternativePosition(), np.array([-75.0, -3.0])
    other.switch(offset, OFFSET_COV)
    other.on_pose(0.5 * PATTERN_HEIGHTS, NO_MASS)
    aside = -offset + np.array([3.0, 7.0])
    assert mahalanobis2(inflated(other, ESTIMATE_COV), aside) < 9.0
    sure = AlternativePosition()
    sure.switch(offset, 0.0 * OFFSET_COV)
    sure.on_pose(0.5 * PATTERN_HEIGHTS, NO_MASS)
    assert mahalanobis2(inflated(sure, ESTIMATE_COV), aside) > 9.0


@pytest.mark.parametrize("fixed", [True, False])
def test_a_position_mapped_before_and_after_the_disagreement_is_wrong_only_if_two_patterns_repeat(fixed: bool) -> None:
    """Rows of fields move a flight by 60 m, and at their end it returns. A start coordinate is no map match."""
    other, offset = AlternativePosition(), np.array([60.0, 0.0])
    for away, map_told in ((offset, fixed), (-offset + 4.0, True)):
        other.spawn([away, away], OFFSET_COV, fixed=map_told)
        assert other.weight == pytest.approx(0.5)
        other.switch(away, OFFSET_COV)
    other.on_pose(0.0, NO_MASS)
    assert other.weight == pytest.approx(0.25 if fixed else 0.5)
    other.on_pose(2.0 * PATTERN_HEIGHTS, NO_MASS)
    assert (other.weight == 0.0) == fixed


def switched(offset_m: np.ndarray, *, fixed: bool = True) -> AlternativePosition:
    """After two matches at ``offset_m`` that agree. ``fixed``: the map has placed the old position."""
    other = AlternativePosition()
    other.spawn([offset_m, offset_m], OFFSET_COV, fixed=fixed)
    other.switch(offset_m, OFFSET_COV)
    return other


def test_a_previously_mapped_position_outlasts_half_a_minute_over_repeating_rows() -> None:
    """One repeating pattern explains all matches since the switch."""
    offset = np.array([26.0, 45.0])
    other = switched(offset)
    other.on_pose(0.0, NO_MASS)
    assert other.weight == pytest.approx(0.5)
    for _ in range(30):
        other.on_pose(20.0 / 78.0, NO_MASS)
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991


def test_below_the_reached_probability_the_offset_covariance_is_scaled_down() -> None:
    other, offset = AlternativePosition(), np.array([60.0, 0.0])
    other.switch(offset, OFFSET_COV)
    other.on_pose(heights_to(REACHED_PROBABILITY) - 0.1, NO_MASS)
    assert other.moments_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1])
    other.on_pose(heights_to(0.06) - heights_to(REACHED_PROBABILITY) + 0.1, NO_MASS)
    assert other.moments_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1] * 0.06 / REACHED_PROBABILITY)


def test_an_unconfirmed_start_decays_faster_than_a_mapped_position() -> None:
    unconfirmed, mapped = (switched(np.array([200.0, 200.0]), fixed=fixed) for fixed in (False, True))
    for other in (unconfirmed, mapped):
        other.on_pose(PATTERN_HEIGHTS / SHARE_START, NO_MASS)
    assert unconfirmed.weight == pytest.approx(1.0 / (1.0 + np.e))
    assert mapped.weight == pytest.approx(1.0 / (1.0 + np.exp(SHARE_MAPPED / SHARE_START)))
    for other in (unconfirmed, mapped):
        other.on_pose(2.0 * PATTERN_HEIGHTS / SHARE_START, NO_MASS)
    assert unconfirmed.weight == 0.0 and mapped.weight > 0.3


@pytest.mark.parametrize(("fixed", "after_70_percent", "after_all"), [(False, 0.3, 0.0), (True, 0.5, 0.5)])
def test_only_a_start_without_mass_in_the_belief_is_removed_without_new_ground(
    fixed: bool, after_70_percent: float, after_all: float
) -> None:
    """The belief began at the unconfirmed: its mass there is outside of the mode of the pose."""
    other = switched(np.array([200.0, 200.0]), fixed=fixed)
    for mass, expected in ((0.7, after_70_percent), (0.995, after_all)):
        other.on_pose(0.0, mass)
        assert other.weight == pytest.approx(expected)
