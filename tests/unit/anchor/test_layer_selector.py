"""Which layer of several dates is used: the one that fits, found from few looks; another one over other ground."""

import numpy as np
import pytest

from terrafix.anchor.matching.layer_selector import MEMORY, PAIRS, PROBE_EVERY, LayerChoice

NOISE = 1.5  # of the scores from frame to frame, the same for all layers of one place


def fly(
    choice: LayerChoice, fits: dict[str, float | None], frames: int, seed: int = 0, weight: float = 1.0
) -> list[int]:
    """How many layers were looked at, frame by frame. ``fits``: mean score of each layer; None: it has nothing."""
    rng = np.random.default_rng(seed)
    looks = []
    for _ in range(frames):
        wanted = choice.wanted()
        place = rng.normal(0.0, NOISE)
        scores = {t: None if (fit := fits[t]) is None else fit + place + rng.normal(0.0, 0.3) for t in wanted}
        used = choice.looked(scores, weight)
        assert used is None or scores.get(used, 0.0) is not None
        looks.append(len(wanted))
    return looks


def test_one_layer_costs_nothing() -> None:
    choice = LayerChoice(["imagery"])
    assert fly(choice, {"imagery": 1.0}, 50) == [1] * 50 and choice.best == "imagery"


@pytest.mark.parametrize("seed", range(10))
def test_the_layer_that_fits_is_found_and_kept(seed: int) -> None:
    choice = LayerChoice(["new", "old", "oldest"])
    fly(choice, {"new": 4.0, "old": 6.0, "oldest": 4.5}, 10, seed)
    assert choice.best == "old"
    looks = fly(choice, {"new": 4.0, "old": 6.0, "oldest": 4.5}, 400, seed)
    assert choice.best == "old"
    assert sum(looks) < 400 * (1 + 1.3 / PROBE_EVERY)


def test_equal_layers_are_not_swapped_for_long() -> None:
    """One as good as another: chance may swap them, but does not play with them."""
    rng, choice, swaps = np.random.default_rng(0), LayerChoice(["new", "old"]), 0
    for _ in range(1000):
        before = choice.best
        choice.looked({table: 5.0 + rng.normal(0.0, 0.3) for table in choice.wanted()}, 1.0)
        swaps += choice.best != before
    assert swaps <= 2


def test_another_ground_another_layer() -> None:
    choice = LayerChoice(["new", "old"])
    fly(choice, {"new": 6.0, "old": 4.0}, 100)
    assert choice.best == "new"
    fly(choice, {"new": 1.0, "old": 6.0}, round(PAIRS + MEMORY))  # poor scores: asked at once, not only now and then
    assert choice.best == "old"


def test_a_layer_that_ends_hands_over_and_learns_nothing() -> None:
    choice = LayerChoice(["new", "old"])
    fly(choice, {"new": 6.0, "old": 4.0}, 30)
    assert choice.looked({"new": None, "old": 4.0}, 1.0) == "old" and choice.best == "new"
    assert choice.wanted() == ("new", "old")  # beyond the edge both are asked, each time
    assert choice.looked({"new": None, "old": None}, 1.0) is None
    assert choice.looked({"new": 6.0, "old": 4.0}, 1.0) == "new"


def test_the_same_ground_again_and_again_counts_little() -> None:
    choice = LayerChoice(["new", "old"])
    fly(choice, {"new": 4.0, "old": 8.0}, 20, weight=0.08)
    assert choice.best == "new"
