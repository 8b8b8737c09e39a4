"""What the covariance leaves to the other place, while map matches and graph disagree and after the graph went over."""

import numpy as np
import pytest

from terrafix.estimator.integrity.other_place import EVEN, FORGET_OVER, REACHED, START_LASTS, OtherPlace

FROM_MAP = np.diag([4.0, 4.0, 9.0, 1e-4, 1e-4, 1e-4])
MASS = 0.0  # of the belief where the pose is: it has nothing to say
APART = np.diag([16.0, 25.0])  # what estimate and match together do not know of the offset


def mahalanobis2(cov: np.ndarray, error_m: np.ndarray) -> float:
    return float(error_m @ np.linalg.solve(cov[:2, :2], error_m))


def added(other: OtherPlace, cov: np.ndarray) -> np.ndarray:
    """``cov`` (6, 6) with the spread of the two places."""
    cov = cov.copy()
    cov[:2, :2] += other.spread_m2()
    return cov


def test_one_refused_match_is_a_mistake_and_changes_nothing() -> None:
    other = OtherPlace()
    other.disagreed([np.array([350.0, 0.0])], APART, fixed=True)
    assert np.array_equal(added(other, FROM_MAP), FROM_MAP)


def test_two_that_agree_bring_the_other_place_into_the_ellipse_and_nothing_else() -> None:
    other, offset = OtherPlace(), np.array([60.0, -30.0])
    other.disagreed([offset + 1.0, offset - 1.0], APART, fixed=True)
    cov = added(other, FROM_MAP)
    assert mahalanobis2(cov, offset) < 5.991
    across = np.array([30.0, 60.0])
    assert mahalanobis2(cov, across) > 50.0
    assert np.array_equal(cov[2:], FROM_MAP[2:])


def test_who_went_over_keeps_the_place_that_was_left_until_new_ground_has_spoken() -> None:
    other, offset = OtherPlace(), np.array([0.0, 80.0])
    other.left(offset, APART)
    assert mahalanobis2(added(other, FROM_MAP), -offset) < 5.991
    other.fade(0.0, MASS)  # hovering proves nothing
    assert mahalanobis2(added(other, FROM_MAP), -offset) < 5.991
    for _ in range(10):
        other.fade(0.4 * FORGET_OVER / 10, MASS)
    assert mahalanobis2(added(other, FROM_MAP), -offset) < 5.991
    other.fade(5.0 * FORGET_OVER, MASS)
    assert np.array_equal(added(other, FROM_MAP), FROM_MAP)


def test_the_other_place_is_known_as_well_as_estimate_and_match_were() -> None:
    """A plane without IMU had drifted by 8 m when it went over, and the place that was left lay aside of the offset."""
    other, offset = OtherPlace(), np.array([-75.0, -3.0])
    other.left(offset, APART)
    other.fade(0.5 * FORGET_OVER, MASS)
    aside = -offset + np.array([3.0, 7.0])
    assert mahalanobis2(added(other, FROM_MAP), aside) < 9.0
    sure = OtherPlace()
    sure.left(offset, 0.0 * APART)
    sure.fade(0.5 * FORGET_OVER, MASS)
    assert mahalanobis2(added(sure, FROM_MAP), aside) > 9.0


@pytest.mark.parametrize("fixed", [True, False])
def test_a_place_that_the_map_told_before_and_after_is_wrong_only_if_two_patterns_repeat(fixed: bool) -> None:
    """Rows of fields lead a flight 60 m away, and where they end it returns. A start coordinate is not the map."""
    other, offset = OtherPlace(), np.array([60.0, 0.0])
    for away, map_told in ((offset, fixed), (-offset + 4.0, True)):
        other.disagreed([away, away], APART, fixed=map_told)
        assert other.probability == pytest.approx(EVEN)
        other.left(away, APART)
    other.fade(0.0, MASS)
    assert other.probability == pytest.approx(EVEN**2 if fixed else EVEN)
    other.fade(2.0 * FORGET_OVER, MASS)
    assert (other.probability == 0.0) == fixed


def test_a_place_to_which_the_flight_was_led_has_the_map_on_one_side_only() -> None:
    other, offset = OtherPlace(), np.array([60.0, 0.0])
    other.disagreed([offset, offset], APART, fixed=True)
    other.left(offset, APART)
    other.fade(0.0, MASS)
    assert other.probability == pytest.approx(EVEN)


def test_rows_that_a_plane_crosses_for_half_a_minute_hide_no_place_that_the_map_had_told() -> None:
    other, offset = OtherPlace(), np.array([26.0, 45.0])
    other.disagreed([offset, offset], APART, fixed=True)
    other.left(offset, APART)
    for _ in range(30):
        other.fade(20.0 / 78.0, MASS)
    assert mahalanobis2(added(other, FROM_MAP), -offset) < 5.991


def test_an_ellipse_that_does_not_reach_the_other_place_is_not_as_wide_as_that_is_unknown() -> None:
    other, offset = OtherPlace(), np.array([60.0, 0.0])
    other.left(offset, APART)
    other.fade(FORGET_OVER * np.log(EVEN / REACHED), MASS)
    assert other.spread_m2()[1, 1] == pytest.approx(APART[1, 1])
    other.fade(FORGET_OVER * np.log(2.0), MASS)
    assert other.spread_m2()[1, 1] == pytest.approx(APART[1, 1] / 2.0)


def test_a_start_that_no_map_match_bore_out_is_forgotten_soon() -> None:
    start, told = OtherPlace(), OtherPlace()
    for other, fixed in ((start, False), (told, True)):
        other.disagreed([np.array([200.0, 200.0])] * 2, APART, fixed=fixed)
        other.left(np.array([200.0, 200.0]), APART)
        other.fade(FORGET_OVER * START_LASTS, MASS)
    assert start.probability == pytest.approx(EVEN * np.exp(-1.0))
    start.fade(3.0 * FORGET_OVER * START_LASTS, MASS)
    told.fade(3.0 * FORGET_OVER * START_LASTS, MASS)
    assert start.probability == 0.0 and told.probability > 0.3


def test_a_start_that_the_belief_gives_no_mass_is_forgotten_without_any_way() -> None:
    """The belief began at the start: what it has left of that is not in the mode of the pose."""
    start, told = OtherPlace(), OtherPlace()
    for other, fixed in ((start, False), (told, True)):
        other.disagreed([np.array([200.0, 200.0])] * 2, APART, fixed=fixed)
        other.left(np.array([200.0, 200.0]), APART)
        other.fade(0.0, 0.7)
        assert other.probability == pytest.approx(EVEN if fixed else 0.3)
        other.fade(0.0, 0.995)
    assert start.probability == 0.0
    assert told.probability == pytest.approx(EVEN)
