"""Null model of a map (scores of the best wrong place) and the false-alarm budget of a flight."""

import math

import msgspec
import numpy as np
import pytest

from terrafix.map.null_model import (
    DEFAULT_NULL,
    FALSE_DETECTIONS_PER_FLIGHT,
    PRIOR_COUNT,
    SCORE_VERSION,
    TAIL_QUANTILE,
    FalseAlarmBudget,
    NullModel,
    NullRow,
    Tail,
    null_row_for,
)

PRIOR = Tail(above=0.0, share=0.1, count=10.0, excess=20.0)  # falls by a factor of e every 2


def row(agl_m: float = 100.0, places: float = 1000.0) -> NullRow:
    return NullRow(agl_m=agl_m, places=places, search=PRIOR, frame=PRIOR, patches=(0.0, 1.0))


def test_a_fitted_tail_reproduces_the_exceedance_probabilities_of_its_values() -> None:
    values = np.random.default_rng(3).exponential(2.0, 20_000)
    tail = Tail.fit(values.tolist(), PRIOR)
    assert tail.share == pytest.approx(1.0 - TAIL_QUANTILE, rel=0.01)
    for probability in (3e-2, 1e-2, 1e-3):
        value = tail.exceedance_value(math.log(probability))
        assert float(np.mean(values >= value)) == pytest.approx(probability, rel=0.35)
        assert tail.log_probability(value) == pytest.approx(math.log(probability))


def test_with_few_values_the_prior_dominates_and_the_threshold_is_higher() -> None:
    """With the same mean excess, the tail fitted to ten values is heavier than that of a thousand."""
    few, many = (
        Tail(above=0.0, share=0.1, count=count, excess=2.0 * count) for count in (PRIOR_COUNT, 100.0 * PRIOR_COUNT)
    )
    assert few.exceedance_value(-12.0) > many.exceedance_value(-12.0) + 3.0
    one = Tail.fit([1.0, 2.0], PRIOR)
    assert one.count == PRIOR_COUNT + 1.0
    assert one.excess == pytest.approx(0.1 + PRIOR_COUNT * 2.0)


def test_below_the_tail_the_exceedance_probability_is_one() -> None:
    assert PRIOR.log_probability(0.0) == 0.0
    assert PRIOR.log_probability(1e-9) == pytest.approx(math.log(0.1))
    assert PRIOR.exceedance_value(math.log(0.5)) == PRIOR.above


def test_more_places_raise_the_threshold_and_fewer_do_not_lower_it() -> None:
    """Union bound: ten times as many places reach a value ten times as often."""
    one = row()
    assert (
        one.detection_threshold(10_000.0, -8.0)
        == one.detection_threshold(1000.0, -8.0 - math.log(10.0))
        > one.detection_threshold(1000.0, -8.0)
    )
    assert one.detection_threshold(10.0, -8.0) == one.detection_threshold(1000.0, -8.0)


def test_the_row_of_the_nearest_height_is_used_or_the_default_without_a_usable_model() -> None:
    model = NullModel(version=SCORE_VERSION, matcher="gradient", rows=(row(80.0), row(160.0)))
    assert null_row_for(model, "gradient", 110.0).agl_m == 80.0
    assert null_row_for(model, "gradient", 115.0).agl_m == 160.0
    for unusable in (
        None,
        msgspec.structs.replace(model, version=SCORE_VERSION + 1),
        msgspec.structs.replace(model, matcher="other"),
        msgspec.structs.replace(model, rows=()),
    ):
        assert null_row_for(unusable, "gradient", 110.0) is DEFAULT_NULL


def test_all_decisions_of_a_flight_together_spend_the_budget() -> None:
    budget, spent = FalseAlarmBudget(), 0.0
    for _ in range(5000):
        budget.spend()
        spent += math.exp(budget.log_probability)
    assert spent == pytest.approx(0.5 * FALSE_DETECTIONS_PER_FLIGHT, rel=1e-3)
    assert spent < 0.5 * FALSE_DETECTIONS_PER_FLIGHT


def test_an_unspent_budget_has_the_share_of_the_first_decision() -> None:
    budget = FalseAlarmBudget()
    before = budget.log_probability
    budget.spend()
    assert budget.log_probability == before
    budget.spend()
    assert budget.log_probability < before


def test_repeated_decisions_accept_wrong_places_within_the_false_alarm_budget() -> None:
    """Flights of forty decisions over places whose evidence follows the null model."""
    draw, flights, decisions, share = np.random.default_rng(5), 4000, 40, 0.05
    tail = Tail(above=2.0, share=0.1, count=1e6, excess=1.5e6)
    null = NullRow(agl_m=100.0, places=1000.0, search=tail, frame=tail, patches=(0.0, 1.0))
    found = 0
    for _ in range(flights):
        budget = FalseAlarmBudget(share)
        beyond = draw.random(decisions) < tail.share
        best = np.where(beyond, 2.0 + draw.exponential(1.5, decisions), 0.0)
        for value in best:
            budget.spend()
            if value >= null.detection_threshold(1000.0, budget.log_probability):
                found += 1
                break
    assert 0.5 * share < found / flights < 1.2 * share
