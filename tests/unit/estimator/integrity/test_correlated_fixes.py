"""Correlation of map fixes: the share of information that a fix over known ground adds."""

import numpy as np
import pytest

from terrafix.estimator.integrity.correlated_fixes import MAX_FIXES, CorrelatedFixes

AGL_M = 100.0
CORRELATED_M = 50.0  # half a height: fixes closer together share their map error


def at(e_m: float, n_m: float = 0.0) -> np.ndarray:
    return np.array([e_m, n_m])


def fixes(*placed: tuple[float, float]) -> CorrelatedFixes:
    """Fixes at (time [s], east [m])."""
    known = CorrelatedFixes()
    for t_s, e_m in placed:
        known.add(t_s, at(e_m))
    return known


def test_the_first_fix_has_all_of_its_information() -> None:
    known = CorrelatedFixes()
    assert known.newest_s is None
    assert known.information_share(3.0, at(0.0), AGL_M) == 1.0


@pytest.mark.parametrize(
    ("away_m", "share"), [(0.5 * CORRELATED_M, 0.5), (0.2 * CORRELATED_M, 0.2), (CORRELATED_M, 1.0), (400.0, 1.0)]
)
def test_a_fix_over_partly_new_ground_has_the_share_of_new_ground(away_m: float, share: float) -> None:
    known = fixes((0.0, 0.0))
    assert known.information_share(10.0, at(away_m), AGL_M) == pytest.approx(share)
    assert known.information_share(10.0, at(0.0, -away_m), AGL_M) == pytest.approx(share)
    assert known.information_share(10.0, at(2.0 * away_m), 2.0 * AGL_M) == pytest.approx(share)


@pytest.mark.parametrize(("since_s", "share"), [(0.1, 0.02), (0.25, 0.05), (0.5, 0.1), (5.0, 0.1), (600.0, 0.1)])
def test_over_the_same_ground_time_gives_at_most_a_tenth_of_the_information(since_s: float, share: float) -> None:
    """Five fixes within a second add no more than two."""
    known = fixes((20.0, 0.0))
    assert known.information_share(20.0 + since_s, at(0.0), AGL_M) == pytest.approx(share)
    assert known.information_share(20.0 - since_s, at(0.0), AGL_M) == pytest.approx(share)


def test_a_second_fix_of_the_same_frame_adds_almost_nothing_but_has_a_finite_covariance() -> None:
    assert fixes((20.0, 0.0)).information_share(20.0, at(0.0), AGL_M) == pytest.approx(1e-3)


def test_a_late_fix_between_two_others_adds_only_the_detour() -> None:
    known = fixes((0.0, 0.0), (10.0, 40.0))
    assert known.new_ground_m(5.0, at(20.0), 1e3) == pytest.approx(0.0)
    assert known.new_ground_m(5.0, at(20.0, 15.0), 1e3) == pytest.approx(2.0 * 25.0 - 40.0)
    assert known.new_ground_m(15.0, at(70.0), 1e3) == pytest.approx(30.0)
    assert known.new_ground_m(-5.0, at(-30.0), 1e3) == pytest.approx(30.0)


def test_the_sum_of_new_ground_does_not_depend_on_the_order_of_arrival() -> None:
    placed = [(0.0, at(0.0)), (1.0, at(12.0)), (2.0, at(20.0, 9.0)), (3.0, at(45.0)), (4.0, at(60.0, -4.0))]
    sums_m = []
    for order in ((0, 1, 2, 3, 4), (4, 2, 0, 3, 1), (2, 4, 3, 1, 0)):
        known, sum_m = CorrelatedFixes(), 0.0
        for i in order:
            sum_m += known.new_ground_m(*placed[i], CORRELATED_M)
            known.add(*placed[i])
        sums_m.append(sum_m)
    assert sums_m == pytest.approx([sums_m[0]] * 3)


def test_the_oldest_fixes_are_forgotten_and_the_newest_one_has_the_newest_time() -> None:
    known = fixes(*((float(i), 100.0 * i) for i in reversed(range(MAX_FIXES + 5))))
    assert known.newest_s == MAX_FIXES + 4.0
    assert len(known._fixes) == MAX_FIXES
