"""Layer selector: the best layer is selected from few observations, and another one over other ground."""

import numpy as np
import pytest

from terrafix.anchor.matching.layer_selector import MAX_WEIGHT_SUM, MIN_LAYER_PAIRS, PROBE_INTERVAL, LayerSelector

NOISE = 1.5  # 1-sigma of the scores between frames, common to all layers at one place


def fly(
    selector: LayerSelector, fits: dict[str, float | None], frames: int, seed: int = 0, weight: float = 1.0
) -> list[int]:
    """Number of layers correlated per frame. ``fits``: mean score of each layer; None: no data."""
    rng = np.random.default_rng(seed)
    counts = []
    for _ in range(frames):
        tables = selector.layers_to_correlate()
        place = rng.normal(0.0, NOISE)
        scores = {t: None if (fit := fits[t]) is None else fit + place + rng.normal(0.0, 0.3) for t in tables}
        used = selector.update(scores, weight)
        assert used is None or scores.get(used, 0.0) is not None
        counts.append(len(tables))
    return counts


def test_a_single_layer_is_never_compared() -> None:
    selector = LayerSelector(["imagery"])
    assert fly(selector, {"imagery": 1.0}, 50) == [1] * 50 and selector.best == "imagery"


@pytest.mark.parametrize("seed", range(10))
def test_the_best_layer_is_selected_and_stays_selected(seed: int) -> None:
    selector = LayerSelector(["new", "old", "oldest"])
    fly(selector, {"new": 4.0, "old": 6.0, "oldest": 4.5}, 10, seed)
    assert selector.best == "old"
    counts = fly(selector, {"new": 4.0, "old": 6.0, "oldest": 4.5}, 400, seed)
    assert selector.best == "old"
    assert sum(counts) < 400 * (1 + 1.3 / PROBE_INTERVAL)


def test_equal_layers_are_rarely_swapped() -> None:
    """Equal layers may be swapped by noise, but rarely."""
    rng, selector, swaps = np.random.default_rng(0), LayerSelector(["new", "old"]), 0
    for _ in range(1000):
        before = selector.best
        selector.update({table: 5.0 + rng.normal(0.0, 0.3) for table in selector.layers_to_correlate()}, 1.0)
        swaps += selector.best != before
    assert swaps <= 2


def test_the_selection_follows_a_change_of_ground() -> None:
    selector = LayerSelector(["new", "old"])
    fly(selector, {"new": 6.0, "old": 4.0}, 100)
    assert selector.best == "new"
    fly(
        selector, {"new": 1.0, "old": 6.0}, round(MIN_LAYER_PAIRS + MAX_WEIGHT_SUM)
    )  # poor scores: another layer is tried with every frame
    assert selector.best == "old"


def test_a_layer_without_data_is_replaced_without_updating_the_difference() -> None:
    selector = LayerSelector(["new", "old"])
    fly(selector, {"new": 6.0, "old": 4.0}, 30)
    assert selector.update({"new": None, "old": 4.0}, 1.0) == "old" and selector.best == "new"
    assert selector.layers_to_correlate() == ("new", "old")  # beyond its edge both layers are tried every time
    assert selector.update({"new": None, "old": None}, 1.0) is None
    assert selector.update({"new": 6.0, "old": 4.0}, 1.0) == "new"


def test_repeated_observations_of_the_same_ground_have_little_weight() -> None:
    selector = LayerSelector(["new", "old"])
    fly(selector, {"new": 4.0, "old": 8.0}, 20, weight=0.08)
    assert selector.best == "new"
