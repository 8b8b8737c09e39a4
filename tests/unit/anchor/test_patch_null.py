"""What the best wrong place of a map scores, and what a flight may spend on taking one for the right place."""

import math

import msgspec
import numpy as np
import pytest

from terrafix.map.null_model import (
    PRIOR_EXCESSES,
    TAIL_FROM,
    USUAL,
    VERSION,
    WRONG_FLIGHTS,
    FlightBudget,
    NullModel,
    NullRow,
    Tail,
    null_at,
)

PRIOR = Tail(above=0.0, share=0.1, count=10.0, excess=20.0)  # falls off by e every 2


def row(agl_m: float = 100.0, places: float = 1000.0) -> NullRow:
    return NullRow(agl_m=agl_m, places=places, search=PRIOR, frame=PRIOR, patches=(0.0, 1.0))


def test_a_fitted_tail_has_the_probabilities_of_the_values_that_it_was_fitted_to() -> None:
    values = np.random.default_rng(3).exponential(2.0, 20_000)
    tail = Tail.of(values.tolist(), PRIOR)
    assert tail.share == pytest.approx(1.0 - TAIL_FROM, rel=0.01)
    for probability in (3e-2, 1e-2, 1e-3):
        value = tail.exceeded_with(math.log(probability))
        assert float(np.mean(values >= value)) == pytest.approx(probability, rel=0.35)
        assert tail.log_probability(value) == pytest.approx(math.log(probability))


def test_few_values_are_completed_by_other_maps_and_demand_more() -> None:
    """Of an equal mean excess, ten values promise less far beyond them than a thousand."""
    few, many = (
        Tail(above=0.0, share=0.1, count=count, excess=2.0 * count)
        for count in (PRIOR_EXCESSES, 100.0 * PRIOR_EXCESSES)
    )
    assert few.exceeded_with(-12.0) > many.exceeded_with(-12.0) + 3.0
    one = Tail.of([1.0, 2.0], PRIOR)
    assert one.count == PRIOR_EXCESSES + 1.0
    assert one.excess == pytest.approx(0.1 + PRIOR_EXCESSES * 2.0)


def test_below_the_tail_nothing_is_improbable() -> None:
    assert PRIOR.log_probability(0.0) == 0.0
    assert PRIOR.log_probability(1e-9) == pytest.approx(math.log(0.1))
    assert PRIOR.exceeded_with(math.log(0.5)) == PRIOR.above


def test_more_places_demand_more_evidence_and_fewer_no_less() -> None:
    """A union bound: ten times as many reach a value ten times as often."""
    one = row()
    assert one.enough(10_000.0, -8.0) == one.enough(1000.0, -8.0 - math.log(10.0)) > one.enough(1000.0, -8.0)
    assert one.enough(10.0, -8.0) == one.enough(1000.0, -8.0)


def test_the_row_of_the_nearest_height_is_used_and_a_usual_one_without_a_usable_model() -> None:
    model = NullModel(version=VERSION, matcher="gradient", rows=(row(80.0), row(160.0)))
    assert null_at(model, "gradient", 110.0).agl_m == 80.0
    assert null_at(model, "gradient", 115.0).agl_m == 160.0
    for unusable in (
        None,
        msgspec.structs.replace(model, version=VERSION + 1),
        msgspec.structs.replace(model, matcher="other"),
        msgspec.structs.replace(model, rows=()),
    ):
        assert null_at(unusable, "gradient", 110.0) is USUAL


def test_all_decisions_of_a_flight_together_spend_what_it_may() -> None:
    budget, spent = FlightBudget(), 0.0
    for _ in range(5000):
        budget.spend()
        spent += math.exp(budget.log_probability)
    assert spent == pytest.approx(0.5 * WRONG_FLIGHTS, rel=1e-3)
    assert spent < 0.5 * WRONG_FLIGHTS


def test_a_budget_that_nothing_was_spent_of_has_the_share_of_a_first_decision() -> None:
    budget = FlightBudget()
    before = budget.log_probability
    budget.spend()
    assert budget.log_probability == before
    budget.spend()
    assert budget.log_probability < before


def test_wrong_places_that_are_tried_again_and_again_are_found_in_no_more_flights_than_said() -> None:
    """Flights of forty decisions over places whose evidence falls off as the model has it."""
    draw, flights, decisions, share = np.random.default_rng(5), 4000, 40, 0.05
    tail = Tail(above=2.0, share=0.1, count=1e6, excess=1.5e6)
    null = NullRow(agl_m=100.0, places=1000.0, search=tail, frame=tail, patches=(0.0, 1.0))
    found = 0
    for _ in range(flights):
        budget = FlightBudget(share)
        beyond = draw.random(decisions) < tail.share
        best = np.where(beyond, 2.0 + draw.exponential(1.5, decisions), 0.0)
        for value in best:
            budget.spend()
            if value >= null.enough(1000.0, budget.log_probability):
                found += 1
                break
    assert 0.5 * share < found / flights < 1.2 * share
