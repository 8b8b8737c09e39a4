"""The claim: named terms whose sum is the published covariance."""

from itertools import pairwise

import msgspec
import pytest

from simulated_flight import ORIGIN, EstimatorRun, Flight
from terrafix.messages import ClaimBudget, MapMatch, NavEstimate

FRAMES = 24
TERMS = {"graph", "map", "principal_point", "time_offset", "hypotheses", "calibration"}


@pytest.fixture(scope="module")
def run() -> EstimatorRun:
    return EstimatorRun().fly(Flight(FRAMES, seed=4, dem=True), 0, FRAMES)


def test_the_terms_add_up_to_the_published_horizontal_variance(run: EstimatorRun) -> None:
    budgets = [m for m in run.published if isinstance(m, ClaimBudget)]
    assert len(budgets) > 5
    for budget in budgets:
        estimate = next(m for m in run.published if isinstance(m, NavEstimate) and m.frame_id == budget.frame_id)
        assert set(budget.terms_m2) == TERMS
        assert sum(budget.terms_m2.values()) == pytest.approx(0.5 * (estimate.cov[0] + estimate.cov[7]))


def test_the_term_of_the_map_is_the_variance_that_the_map_states() -> None:
    run, flight = EstimatorRun(), Flight(FRAMES, seed=4, dem=True)
    run.feed([ORIGIN])
    for message in flight.all_messages():
        run.feed([msgspec.structs.replace(message, map_sigma_m=3.0) if isinstance(message, MapMatch) else message])
    budget = next(m for m in run.published if isinstance(m, ClaimBudget))
    assert budget.terms_m2["map"] == pytest.approx(9.0)


def test_the_budget_is_published_once_a_second_after_the_first_map_match(run: EstimatorRun) -> None:
    times_s = [m.t_ns * 1e-9 for m in run.published if isinstance(m, ClaimBudget)]
    assert min(b - a for a, b in pairwise(times_s)) >= 1.0
