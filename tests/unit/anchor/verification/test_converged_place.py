"""Sequential test of the place that a search of a drawn map has found."""

from terrafix.anchor.verification.converged_place import PLACE_NULL_GAIN, PlaceTest
from terrafix.anchor.verification.lock_monitor import MAX_GAIN
from terrafix.map.null_model import FalseAlarmBudget


def passes_after(test: PlaceTest, evidence_nats: float, most: int = 100) -> int | None:
    """-> number of full observations until the place passes; None: it has not after ``most``."""
    return next((i + 1 for i in range(most) if test.update(evidence_nats, 1.0, dominant=True)), None)


def test_a_place_passes_when_its_gain_exceeds_the_false_alarm_budget() -> None:
    budget = FalseAlarmBudget()
    needed = passes_after(PlaceTest(budget), PLACE_NULL_GAIN + 1.0)
    assert needed == int(-budget.log_probability) + 1 == 9  # 1 in 2000, and the first place may use half of it


def test_a_place_that_gains_what_wrong_places_gain_does_not_pass() -> None:
    assert passes_after(PlaceTest(FalseAlarmBudget()), PLACE_NULL_GAIN) is None


def test_one_observation_gives_no_more_than_its_bound() -> None:
    assert passes_after(PlaceTest(FalseAlarmBudget()), 100.0) == 5
    assert 4 * MAX_GAIN < 8.3 < 5 * MAX_GAIN


def test_another_place_starts_from_the_beginning_and_needs_more() -> None:
    budget = FalseAlarmBudget()
    test = PlaceTest(budget)
    for _ in range(4):
        assert not test.update(100.0, 1.0, dominant=True)
    assert not test.update(100.0, 1.0, dominant=False)
    assert passes_after(test, PLACE_NULL_GAIN + 1.0) == 10  # the first place has spent half of the budget


def test_evidence_against_a_place_is_counted_in_full() -> None:
    test = PlaceTest(FalseAlarmBudget())
    for _ in range(4):
        test.update(100.0, 1.0, dominant=True)
    assert not test.update(-9.0, 1.0, dominant=True)
    assert passes_after(test, 100.0) == 2  # 8 - 3 + 2 x 2 > 8.3
