"""Alternative position: its part of the covariance while matches and graph disagree, and after a switch."""

import numpy as np
import pytest

from terrafix.estimator.integrity.alternative_position import (
    DECAY_FACTOR_START,
    DECAY_HEIGHTS,
    INITIAL_PROBABILITY,
    REACHED_PROBABILITY,
    AlternativePosition,
)

ESTIMATE_COV = np.diag([4.0, 4.0, 9.0, 1e-4, 1e-4, 1e-4])
NO_MASS = 0.0  # of the belief in the mode of the pose: no effect
OFFSET_COV = np.diag([16.0, 25.0])  # covariance of the offset between estimate and match


def mahalanobis2(cov: np.ndarray, error_m: np.ndarray) -> float:
    return float(error_m @ np.linalg.solve(cov[:2, :2], error_m))


def inflated(other: AlternativePosition, cov: np.ndarray) -> np.ndarray:
    """``cov`` (6, 6) with the inflation by the alternative position."""
    cov = cov.copy()
    cov[:2, :2] += other.inflation_m2()
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
    other.decay(0.0, NO_MASS)  # without new ground there is no decay
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
    for _ in range(10):
        other.decay(0.4 * DECAY_HEIGHTS / 10, NO_MASS)
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991
    other.decay(5.0 * DECAY_HEIGHTS, NO_MASS)
    assert np.array_equal(inflated(other, ESTIMATE_COV), ESTIMATE_COV)


def test_the_alternative_position_has_the_covariance_of_its_offset() -> None:
    """A plane without IMU had drifted by 8 m at the switch, and the old position lay aside of the offset."""
    other, offset = AlternativePosition(), np.array([-75.0, -3.0])
    other.switch(offset, OFFSET_COV)
    other.decay(0.5 * DECAY_HEIGHTS, NO_MASS)
    aside = -offset + np.array([3.0, 7.0])
    assert mahalanobis2(inflated(other, ESTIMATE_COV), aside) < 9.0
    sure = AlternativePosition()
    sure.switch(offset, 0.0 * OFFSET_COV)
    sure.decay(0.5 * DECAY_HEIGHTS, NO_MASS)
    assert mahalanobis2(inflated(sure, ESTIMATE_COV), aside) > 9.0


@pytest.mark.parametrize("fixed", [True, False])
def test_a_position_mapped_before_and_after_the_disagreement_is_wrong_only_if_two_patterns_repeat(fixed: bool) -> None:
    """Rows of fields move a flight by 60 m, and at their end it returns. A start coordinate is no map match."""
    other, offset = AlternativePosition(), np.array([60.0, 0.0])
    for away, map_told in ((offset, fixed), (-offset + 4.0, True)):
        other.spawn([away, away], OFFSET_COV, fixed=map_told)
        assert other.probability == pytest.approx(INITIAL_PROBABILITY)
        other.switch(away, OFFSET_COV)
    other.decay(0.0, NO_MASS)
    assert other.probability == pytest.approx(INITIAL_PROBABILITY**2 if fixed else INITIAL_PROBABILITY)
    other.decay(2.0 * DECAY_HEIGHTS, NO_MASS)
    assert (other.probability == 0.0) == fixed


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
    other.decay(0.0, NO_MASS)
    assert other.probability == pytest.approx(INITIAL_PROBABILITY)
    for _ in range(30):
        other.decay(20.0 / 78.0, NO_MASS)
    assert mahalanobis2(inflated(other, ESTIMATE_COV), -offset) < 5.991


def test_below_the_reached_probability_the_offset_covariance_is_scaled_down() -> None:
    other, offset = AlternativePosition(), np.array([60.0, 0.0])
    other.switch(offset, OFFSET_COV)
    other.decay(DECAY_HEIGHTS * np.log(INITIAL_PROBABILITY / REACHED_PROBABILITY), NO_MASS)
    assert other.inflation_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1])
    other.decay(DECAY_HEIGHTS * np.log(2.0), NO_MASS)
    assert other.inflation_m2()[1, 1] == pytest.approx(OFFSET_COV[1, 1] / 2.0)


def test_an_unconfirmed_start_decays_faster_than_a_mapped_position() -> None:
    unconfirmed, mapped = (switched(np.array([200.0, 200.0]), fixed=fixed) for fixed in (False, True))
    for other in (unconfirmed, mapped):
        other.decay(DECAY_HEIGHTS * DECAY_FACTOR_START, NO_MASS)
    assert unconfirmed.probability == pytest.approx(INITIAL_PROBABILITY * np.exp(-1.0))
    for other in (unconfirmed, mapped):
        other.decay(3.0 * DECAY_HEIGHTS * DECAY_FACTOR_START, NO_MASS)
    assert unconfirmed.probability == 0.0 and mapped.probability > 0.3


@pytest.mark.parametrize(
    ("fixed", "after_70_percent", "after_all"), [(False, 0.3, 0.0), (True, INITIAL_PROBABILITY, INITIAL_PROBABILITY)]
)
def test_only_a_start_without_mass_in_the_belief_is_removed_without_new_ground(
    fixed: bool, after_70_percent: float, after_all: float
) -> None:
    """The belief began at the unconfirmed: its mass there is outside of the mode of the pose."""
    other = switched(np.array([200.0, 200.0]), fixed=fixed)
    for mass, expected in ((0.7, after_70_percent), (0.995, after_all)):
        other.decay(0.0, mass)
        assert other.probability == pytest.approx(expected)
