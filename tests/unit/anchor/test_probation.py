"""A place that a search has found is tested further over new ground: it passes, or it is withdrawn."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from ground import PINHOLE, texture, view
from one_place import AGL_M, ORIGIN, SIDE_M, TRUE_M, OnlyMap, R, predicted
from terrafix.anchor.matching.frame_matcher import AS_PREDICTED, FrameMatcher, View
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.hypothesis_tracker import (
    LLR_MAX,
    NEW_EVIDENCE,
    Found,
    HypothesisTracker,
    PlaceHypothesis,
)
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.relocalizer import anywhere_m, mixed_sigma_m
from terrafix.anchor.verification.lock_monitor import LOOK_MIN
from terrafix.anchor.verification.place_verifier import FINE_PER_AGL
from terrafix.anchor.verification.probation import CALIBRATOR, FAILED_ODDS, PASSED_ODDS, Probation, log_e_value
from terrafix.core.frames import MemoryFrameStore
from terrafix.map.null_model import USUAL, Tail
from terrafix.messages import MapMatch, SearchStep, Verdict
from terrafix_engines.features.gradient import GradientDescriber

STRETCH_M = NEW_EVIDENCE * AGL_M
TENTH = Tail(above=1.0, share=0.1, count=1e6, excess=1e6)
HERE = View(float(TRUE_M[0]), float(TRUE_M[1]), R, AGL_M, 0.0, 0.03, 0.02, 0.02)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


def probation(ground: np.ndarray) -> Probation:
    source: Any = OnlyMap(ground)
    return Probation(HypothesisTracker(source, FrameMatcher(PINHOLE, source, GradientDescriber())), USUAL.frame, AGL_M)


def test_chance_multiplies_the_odds_by_less_than_one_in_the_mean() -> None:
    """What makes the bound on wrong places hold: also with what speaks against a place held to its least."""
    draw = np.random.default_rng(2)
    sigmas = np.where(draw.random(400_000) < TENTH.share, 1.0 + draw.exponential(1.0, 400_000), 0.0)
    gains = [max(log_e_value(TENTH.log_probability(float(s))), LOOK_MIN) for s in sigmas]
    # One at the most: 0.9 exp(LOOK_MIN) and 0.1 ** CALIBRATOR, and what 400 000 draws leave open of a heavy tail.
    assert 0.9 * math.exp(LOOK_MIN) + TENTH.share**CALIBRATOR == pytest.approx(1.0, abs=2e-3)
    assert 0.95 < float(np.mean(np.exp(gains))) <= 1.01


def test_a_place_is_as_likely_wrong_as_right_at_first_and_then_by_its_odds(ground: np.ndarray) -> None:
    test = probation(ground)
    assert test.doubt == 0.5 and not test.passed and not test.failed


def test_the_right_place_passes_over_new_ground(ground: np.ndarray) -> None:
    test, doubts = probation(ground), [0.5]
    picture = view(ground, PINHOLE, R, TRUE_M)
    while not test.passed:
        test.move(STRETCH_M)
        test.look(picture, HERE)
        doubts.append(test.doubt)
        assert len(doubts) < 6
    assert doubts == sorted(doubts, reverse=True)
    assert doubts[-1] <= 1.0 / (1.0 + math.exp(PASSED_ODDS))


def test_one_frame_says_no_more_than_the_most_however_clear_it_is(ground: np.ndarray) -> None:
    test = probation(ground)
    test.move(0.5 * STRETCH_M)
    test.look(view(ground, PINHOLE, R, TRUE_M), HERE)
    assert test.doubt == pytest.approx(1.0 / (1.0 + math.exp(0.5 * LLR_MAX)))


def test_the_same_ground_again_says_nothing_of_the_place(ground: np.ndarray) -> None:
    test, picture = probation(ground), view(ground, PINHOLE, R, TRUE_M)
    for _ in range(5):
        test.look(picture, HERE)
    assert test.doubt == 0.5
    test.move(0.1 * STRETCH_M)
    test.look(picture, HERE)
    little = test.doubt
    test.look(picture, HERE)
    assert test.doubt == little  # that way was counted


def test_a_place_that_nothing_speaks_for_is_given_up_after_some_stretches_of_ground(ground: np.ndarray) -> None:
    source: Any = OnlyMap(ground)
    tracks = HypothesisTracker(source, FrameMatcher(PINHOLE, source, GradientDescriber()))
    other = texture(21, SIDE_M)
    pictures = [
        view(other, PINHOLE, R, np.array([e_m, n_m, AGL_M]))
        for e_m in (-80.0, -40.0, 0.0, 40.0, 80.0)
        for n_m in (-60.0, 60.0)
    ]
    for picture in pictures:  # what chance comes to over this ground: a search has learnt it
        for e_m in (-50.0, 0.0, 50.0):
            checked = tracks.check.at(picture, replace(HERE, e_m=e_m, n_m=20.0), FINE_PER_AGL)
            assert checked is not None
            tracks.chance.learn(checked.agreement, fine=True)
    test, looks = Probation(tracks, USUAL.frame, AGL_M), 0
    while not test.failed:
        test.move(3.0 * STRETCH_M)  # a long step is no more than one stretch
        test.look(pictures[looks % len(pictures)], HERE)
        looks += 1
        assert not test.passed and looks < 20
    assert looks >= FAILED_ODDS / LOOK_MIN
    assert test.doubt > 0.8


def test_a_place_beyond_the_map_or_among_several_speaks_against_itself_by_the_least(ground: np.ndarray) -> None:
    for nowhere in (replace(HERE, e_m=5000.0), None):
        test = probation(ground)
        test.move(STRETCH_M)
        test.look(view(ground, PINHOLE, R, TRUE_M), nowhere)
        assert test.doubt == pytest.approx(1.0 / (1.0 + math.exp(LOOK_MIN)))


# --- in a flight ---------------------------------------------------------------------------------------------


def found_at(e_m: float, n_m: float, ground: np.ndarray) -> Any:
    """A search that finds a place in its first frame: the pose of the picture there."""

    def look(search: MapSearch, _image: np.ndarray, _view: View) -> Found | None:
        there = replace(HERE, e_m=e_m, n_m=n_m)
        true = view(ground, PINHOLE, R, np.array([e_m, n_m, AGL_M]))
        checked = search.tracks.check.at(true, there, 1 / 100)
        assert checked is not None
        return Found(PlaceHypothesis(e_m, n_m, AS_PREDICTED), checked.fix)

    return look


def flown(
    ground: np.ndarray, shown: np.ndarray, monkeypatch: pytest.MonkeyPatch, frames: int, step_m: float
) -> list[MapMatch]:
    """A flight with an unknown start over ``shown``; its search says the same place on the map of ``ground``."""
    package: Any = OnlyMap(ground)
    store = MemoryFrameStore(frames + 1)
    node = AnchorNode(store, package, GradientDescriber(), 1.0)
    list(node.on(msgspec.structs.replace(ORIGIN, start_sigma_m=5000.0)))
    monkeypatch.setattr(MapSearch, "look", found_at(float(TRUE_M[0]) - 100.0, float(TRUE_M[1]), ground))
    said = []
    for i in range(frames):
        if i == 1:
            monkeypatch.setattr(MapSearch, "look", lambda *_: None)
        at_m = TRUE_M + np.array([step_m * i % 200.0 - 100.0, 0.0, 0.0])  # and again over the same ground
        store.put(i, view(shown, PINHOLE, R, at_m))
        match, *_ = node.on(predicted(i, 8.0 if i else 200.0, at_m=at_m, step_m=step_m if i else 0.0))
        assert isinstance(match, MapMatch)
        said.append(match)
    return said


def test_a_find_claims_the_mixture_with_anywhere_until_it_has_passed(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = flown(ground, ground, monkeypatch, 6, 18.0)
    source: Any = OnlyMap(ground)
    assert said[0].found and said[0].lost_sigma_m == pytest.approx(math.sqrt(0.5) * anywhere_m(source))
    assert said[0].lost_sigma_m == mixed_sigma_m(0.5, source)
    assert [m.lost_sigma_m for m in said] == sorted((m.lost_sigma_m for m in said), reverse=True)
    assert said[1].lost_sigma_m > 0.0 and said[-1].lost_sigma_m == 0.0
    assert all(m.verdict is not Verdict.LOST for m in said)


def test_a_wrong_find_is_withdrawn_and_the_search_goes_on_over_the_whole_map(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = flown(ground, texture(21, SIDE_M), monkeypatch, 18, STRETCH_M)
    lost = next(i for i, m in enumerate(said) if m.verdict is Verdict.LOST)
    source: Any = OnlyMap(ground)
    assert lost > 0
    assert all(m.lost_sigma_m >= 0.2 * anywhere_m(source) for m in said)  # never sure of it
    assert said[lost].step is SearchStep.WHOLE_MAP and said[lost].lost_sigma_m == anywhere_m(source)
