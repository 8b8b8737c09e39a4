"""Agreement of a position with the map: the posterior over what may be wrong with it."""

import math

import pytest

from terrafix.core.agreement import NATS, RANGES, Agreement, Cause, Observed
from terrafix.core.gate import MIN_COMPONENT_WEIGHT


def after(*observed: tuple[Observed, Cause, int]) -> Agreement:
    agreement = Agreement()
    for what, cause, times in observed:
        for _ in range(times):
            agreement.observe(what, cause)
    return agreement


def test_before_any_observation_no_cause_has_a_weight() -> None:
    agreement = Agreement()
    assert [agreement.weight(cause) for cause in Cause] == [0.0, 0.0, 0.0, 0.0]
    assert agreement.probability(Cause.DESCRIPTION) == pytest.approx(0.05, rel=0.06)  # one description in twenty


def test_every_observation_is_evidence_for_the_causes_under_which_it_is_more_likely() -> None:
    assert all(nats < 0.0 for nats in NATS[Observed.POSE].values())
    assert NATS[Observed.POSE].keys() == set(Cause) - {Cause.ELSEWHERE}  # images are compared with that place
    assert NATS[Observed.REJECTED] == {Cause.OTHER_GROUND: pytest.approx(math.log(9.0))}
    nothing = pytest.approx(math.log(4.95))
    assert NATS[Observed.NOTHING] == {Cause.START: nothing, Cause.DESCRIPTION: nothing}


def test_the_probabilities_of_all_causes_and_of_a_right_position_sum_to_one() -> None:
    agreement = after((Observed.REJECTED, Cause.OTHER_GROUND, 5), (Observed.NOTHING, Cause.DESCRIPTION, 4))
    agreement.begin(Cause.ELSEWHERE)
    right = 1.0 / (1.0 + sum(math.exp(log_odds) for log_odds in agreement.log_odds.values()))
    assert sum(agreement.probability(cause) for cause in Cause) == pytest.approx(1.0 - right)


def test_two_causes_with_as_much_evidence_share_the_probability() -> None:
    agreement = Agreement()
    for cause in (Cause.ELSEWHERE, Cause.OTHER_GROUND):
        agreement.begin(cause, 3.0)
    agreement.begin(Cause.DESCRIPTION, -math.inf)
    alone = math.exp(3.0) / (1.0 + math.exp(3.0))
    assert agreement.probability(Cause.ELSEWHERE) == agreement.probability(Cause.OTHER_GROUND) < 0.5 < alone


def test_a_cause_below_the_least_component_weight_is_left_out_of_the_mixture() -> None:
    agreement = Agreement({Cause.ELSEWHERE: RANGES[Cause.ELSEWHERE]})
    for probability, weight in ((1.02 * MIN_COMPONENT_WEIGHT,) * 2, (0.98 * MIN_COMPONENT_WEIGHT, 0.0)):
        agreement.begin(Cause.ELSEWHERE, math.log(probability / (1.0 - probability)))
        assert agreement.weight(Cause.ELSEWHERE) == pytest.approx(weight)


def test_new_ground_scales_an_observation() -> None:
    whole, quarters = Agreement(), Agreement()
    whole.observe(Observed.REJECTED, Cause.OTHER_GROUND)
    for _ in range(4):
        quarters.observe(Observed.REJECTED, Cause.OTHER_GROUND, 0.25)
    assert quarters.log_odds == pytest.approx(whole.log_odds)


@pytest.mark.parametrize("cause", [Cause.OTHER_GROUND, Cause.DESCRIPTION])
def test_the_log_odds_stay_within_their_range(cause: Cause) -> None:
    against, limits = Observed.REJECTED if cause is Cause.OTHER_GROUND else Observed.NOTHING, RANGES[cause]
    assert after((against, cause, 100)).log_odds[cause] == limits.most
    least = after((Observed.POSE, cause, 100)).log_odds[cause]
    assert least == (-math.inf if limits.settles else limits.least)


def test_an_excluded_cause_does_not_return_and_other_ground_does() -> None:
    agreement = after((Observed.POSE, Cause.DESCRIPTION, 3), (Observed.POSE, Cause.OTHER_GROUND, 3))
    for _ in range(20):
        agreement.observe(Observed.NOTHING, Cause.DESCRIPTION)
        agreement.observe(Observed.REJECTED, Cause.OTHER_GROUND)
    assert agreement.probability(Cause.DESCRIPTION) == 0.0 and agreement.probability(Cause.OTHER_GROUND) > 0.9


@pytest.mark.parametrize(("least", "expected"), [(0.7, 0.5), (0.3, 0.3), (0.0, 0.0), (1.0, 0.5)])
def test_other_evidence_limits_the_probability_of_a_cause(least: float, expected: float) -> None:
    agreement = Agreement({Cause.ELSEWHERE: RANGES[Cause.ELSEWHERE]})
    agreement.begin(Cause.ELSEWHERE)
    agreement.at_most(Cause.ELSEWHERE, least)
    assert agreement.probability(Cause.ELSEWHERE) == pytest.approx(expected)


def test_forgotten_causes_have_their_prior_again_and_the_others_stay() -> None:
    agreement = after((Observed.REJECTED, Cause.OTHER_GROUND, 5), (Observed.NOTHING, Cause.DESCRIPTION, 2))
    description = agreement.log_odds[Cause.DESCRIPTION]
    agreement.forget(Cause.ELSEWHERE, Cause.OTHER_GROUND)
    assert agreement.log_odds == Agreement().log_odds | {Cause.DESCRIPTION: description}
