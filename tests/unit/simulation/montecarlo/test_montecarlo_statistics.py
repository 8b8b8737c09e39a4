"""Monte Carlo statistics against tables, simulations and closed forms."""

from typing import Any

import numpy as np
import pytest

from terrafix_lab.montecarlo.statistics import band, draws_in, floors, whitened
from terrafix_tools.score import nees_band, nees_of


@pytest.mark.parametrize(
    ("freedom", "low", "high"), [(2, 0.0506, 7.378), (10, 3.247, 20.483), (100, 74.222, 129.561), (1000, 914.3, 1089.5)]
)
def test_chi_square_quantiles_are_those_of_the_tables(freedom: int, low: float, high: float) -> None:
    assert freedom * np.array(nees_band(freedom, 1)) == pytest.approx([low, high], rel=1e-3)


def test_nees_is_the_mahalanobis_distance_and_no_covariance_is_infinite() -> None:
    cov = np.array([[[4.0, 1.0], [1.0, 2.0]], [[1.0, 2.0], [2.0, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]])
    error = np.array([[2.0, -1.0], [0.1, 0.1], [0.0, 0.0]])
    by_hand = (2.0 * 4.0 - 2.0 * 1.0 * -2.0 + 4.0 * 1.0) / 7.0  # adjugate over determinant
    assert nees_of(error, cov)[0] == pytest.approx(by_hand)
    assert np.isinf(nees_of(error, cov)[1:]).all()


def test_whitened_errors_have_the_length_of_the_nees() -> None:
    rng = np.random.default_rng(1)
    root = rng.normal(size=(20, 6, 6))
    cov, error = root @ root.transpose(0, 2, 1), rng.normal(size=(20, 6))
    assert (whitened(error, cov) ** 2).sum(axis=1) == pytest.approx(nees_of(error, cov))


def test_white_errors_give_one_draw_per_frame_and_a_constant_gives_one() -> None:
    white = np.random.default_rng(2).normal(size=(2000, 2))
    assert 1500 < draws_in([white]) <= 2000
    assert draws_in([np.ones((2000, 2))]) == pytest.approx(1.0, rel=0.2)


def test_the_effective_draws_of_a_first_order_process() -> None:
    """First-order process: the squares have the correlation rho^(2 lag), so that n (1 - rho^2) / (1 + rho^2) remain."""
    rho, rng = 0.9, np.random.default_rng(3)
    x = np.zeros((20000, 2))
    for i in range(1, len(x)):
        x[i] = rho * x[i - 1] + np.sqrt(1 - rho**2) * rng.normal(size=2)
    assert draws_in([x]) == pytest.approx(20000 * (1 - rho**2) / (1 + rho**2), rel=0.2)


def test_the_band_contains_95_of_100_consistent_runs_and_no_overconfident_one() -> None:
    """Runs of 20 flights with a constant part of the error, as by the registration of a map."""
    rng = np.random.default_rng(4)
    held = overconfident = 0
    for _ in range(100):
        flights = [np.sqrt(0.5) * (rng.normal(size=2) + rng.normal(size=(200, 2))) for _ in range(20)]
        nees, draws = [(error**2).sum(axis=1) for error in flights], draws_in(flights)
        held += band(nees, draws, 2).holds
        overconfident += band([3.0 * v for v in nees], draws, 2).holds
    assert 86 <= held <= 100
    assert overconfident == 0


def totals(draws: float = 1000.0, **other: object) -> dict[str, Any]:
    good = {"coverage": 0.95, "coverage_refined": 0.96, "late_false_fixes": 0, "flights": 100}
    return {**good, "nees": {"holds": True, "draws": draws}, **other}


def test_each_broken_floor_is_reported() -> None:
    assert set(floors(totals()).values()) == {True}
    for key, bad in (("coverage", 0.99), ("coverage", 0.9), ("coverage_refined", 0.5), ("late_false_fixes", 1)):
        assert list(floors(totals(**{key: bad})).values()).count(False) == 1
    assert False in floors(totals(nees={"holds": False, "draws": 1000.0})).values()


@pytest.mark.parametrize(
    ("coverage", "draws", "expected"),
    [
        (1.0, 40.0, None),  # 0.95^40 = 13 % of consistent samples are inside altogether
        (1.0, 80.0, False),  # 1.7 %
        (0.90, 20.0, None),  # two of twenty outside: 26 %
        (0.75, 20.0, False),  # five of twenty: 0.26 %
        (0.90, 1.0, None),
        (0.95, 1.0, True),
    ],
)
def test_coverage_is_judged_only_where_the_independent_draws_are_enough(
    coverage: float, draws: float, expected: bool | None
) -> None:
    assert next(iter(floors(totals(draws, coverage=coverage)).values())) is expected


def test_flights_without_refined_positions_are_too_few_to_judge_them() -> None:
    assert list(floors(totals(coverage_refined=None)).values()).count(None) == 1


def test_the_floor_of_false_fixes_says_what_no_case_in_so_many_flights_means() -> None:
    assert any("none in 100 flights: in less than 3.0% of all" in floor for floor in floors(totals()))
