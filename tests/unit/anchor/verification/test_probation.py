"""Sequential test of a relocalized place over new ground: it passes or is withdrawn."""

import math
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from single_map_place import AGL_M, ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.frame_matcher import AS_PREDICTED, FrameMatcher, View
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.relocalizer import mixed_sigma_m, unknown_sigma_m
from terrafix.anchor.verification.hypothesis_tracker import (
    NEW_EVIDENCE,
    TRACK_LLR_MAX,
    AcceptedPlace,
    HypothesisTracker,
    PlaceHypothesis,
)
from terrafix.anchor.verification.lock_monitor import MIN_GAIN
from terrafix.anchor.verification.place_verifier import FINE_PLACE_CELL_PER_AGL
from terrafix.anchor.verification.probation import (
    E_VALUE_EXPONENT,
    FAIL_LOG_ODDS,
    PASS_LOG_ODDS,
    Probation,
    log_e_value,
)
from terrafix.core.frames import MemoryFrameStore
from terrafix.map.null_model import DEFAULT_NULL, Tail
from terrafix.messages import MapMatch, SearchStep, Verdict
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, texture, view

STRETCH_M = NEW_EVIDENCE * AGL_M
TENTH = Tail(above=1.0, share=0.1, count=1e6, excess=1e6)
HERE = View(float(TRUE_M[0]), float(TRUE_M[1]), R, AGL_M, 0.0, 0.03, 0.02, 0.02)


def probation(ground: np.ndarray) -> Probation:
    source: Any = SingleMapPackage(ground)
    return Probation(HypothesisTracker(FrameMatcher(PINHOLE, source, GradientDescriber())), DEFAULT_NULL.frame, AGL_M)


def test_under_the_null_model_the_mean_odds_factor_is_below_one() -> None:
    """This property bounds the probability of a wrong place, also with evidence limited below by MIN_GAIN."""
    draw = np.random.default_rng(2)
    sigmas = np.where(draw.random(400_000) < TENTH.share, 1.0 + draw.exponential(1.0, 400_000), 0.0)
    gains = [max(log_e_value(TENTH.log_probability(float(s))), MIN_GAIN) for s in sigmas]
    # At most one: 0.9 exp(MIN_GAIN) + 0.1 ** E_VALUE_EXPONENT, with the sampling error of 400 000 draws from a heavy
    # tail.
    assert 0.9 * math.exp(MIN_GAIN) + TENTH.share**E_VALUE_EXPONENT == pytest.approx(1.0, abs=2e-3)
    assert 0.95 < float(np.mean(np.exp(gains))) <= 1.01


def test_the_wrong_probability_starts_at_one_half_and_follows_the_odds(ground: np.ndarray) -> None:
    test = probation(ground)
    assert test.wrong_probability == 0.5 and not test.passed and not test.failed


def test_the_right_place_passes_over_new_ground(ground: np.ndarray) -> None:
    test, doubts = probation(ground), [0.5]
    image = view(ground, PINHOLE, R, TRUE_M)
    while not test.passed:
        test.predict(STRETCH_M)
        test.update(image, HERE)
        doubts.append(test.wrong_probability)
        assert len(doubts) < 6
    assert doubts == sorted(doubts, reverse=True)
    assert doubts[-1] <= 1.0 / (1.0 + math.exp(PASS_LOG_ODDS))


def test_the_evidence_of_one_frame_is_bounded(ground: np.ndarray) -> None:
    test = probation(ground)
    test.predict(0.5 * STRETCH_M)
    test.update(view(ground, PINHOLE, R, TRUE_M), HERE)
    assert test.wrong_probability == pytest.approx(1.0 / (1.0 + math.exp(0.5 * TRACK_LLR_MAX)))


def test_the_same_ground_gives_no_evidence(ground: np.ndarray) -> None:
    test, image = probation(ground), view(ground, PINHOLE, R, TRUE_M)
    for _ in range(5):
        test.update(image, HERE)
    assert test.wrong_probability == 0.5
    test.predict(0.1 * STRETCH_M)
    test.update(image, HERE)
    little = test.wrong_probability
    test.update(image, HERE)
    assert test.wrong_probability == little  # the path was already counted


@pytest.mark.slow
def test_a_place_without_evidence_fails_after_some_stretches_of_ground(ground: np.ndarray) -> None:
    source: Any = SingleMapPackage(ground)
    tracks = HypothesisTracker(FrameMatcher(PINHOLE, source, GradientDescriber()))
    other = texture(21, SIDE_M)
    images = [
        view(other, PINHOLE, R, np.array([e_m, n_m, AGL_M]))
        for e_m in (-80.0, -40.0, 0.0, 40.0, 80.0)
        for n_m in (-60.0, 60.0)
    ]
    for image in images:  # estimates the null model of this ground, as a search does
        for e_m in (-50.0, 0.0, 50.0):
            checked = tracks.verifier.verify(image, replace(HERE, e_m=e_m, n_m=20.0), FINE_PLACE_CELL_PER_AGL)
            assert checked is not None
            tracks.null.add(checked.consensus, fine=True)
    test, frames = Probation(tracks, DEFAULT_NULL.frame, AGL_M), 0
    while not test.failed:
        test.predict(3.0 * STRETCH_M)  # a long step counts as one stretch
        test.update(images[frames % len(images)], HERE)
        frames += 1
        assert not test.passed and frames < 20
    assert frames >= FAIL_LOG_ODDS / MIN_GAIN
    assert test.wrong_probability > 0.8


def test_a_place_off_the_map_or_without_a_dominant_mode_gives_the_minimum_gain(ground: np.ndarray) -> None:
    for nowhere in (replace(HERE, e_m=5000.0), None):
        test = probation(ground)
        test.predict(STRETCH_M)
        test.update(view(ground, PINHOLE, R, TRUE_M), nowhere)
        assert test.wrong_probability == pytest.approx(1.0 / (1.0 + math.exp(MIN_GAIN)))


# --- in a flight ---------------------------------------------------------------------------------------------


def search_that_accepts(e_m: float, n_m: float, ground: np.ndarray) -> Any:
    """A search that accepts a place in its first frame, with the pose of the image there."""

    def process_frame(search: MapSearch, _image: np.ndarray, _view: View) -> AcceptedPlace | None:
        there = replace(HERE, e_m=e_m, n_m=n_m)
        true = view(ground, PINHOLE, R, np.array([e_m, n_m, AGL_M]))
        checked = search.tracker.verifier.verify(true, there, 1 / 100)
        assert checked is not None
        return AcceptedPlace(PlaceHypothesis(e_m, n_m, AS_PREDICTED), checked.fix)

    return process_frame


def match_flight(
    ground: np.ndarray, shown: np.ndarray, monkeypatch: pytest.MonkeyPatch, frames: int, step_m: float
) -> list[MapMatch]:
    """A flight with an unknown start over ``shown``; its search accepts the same place on the map of ``ground``."""
    package: Any = SingleMapPackage(ground)
    store = MemoryFrameStore(frames + 1)
    node = AnchorNode(store, package, GradientDescriber(), 1.0)
    list(node.on(msgspec.structs.replace(ORIGIN, start_sigma_m=5000.0)))
    monkeypatch.setattr(
        MapSearch, "process_frame", search_that_accepts(float(TRUE_M[0]) - 100.0, float(TRUE_M[1]), ground)
    )
    matches = []
    for i in range(frames):
        if i == 1:
            monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
        at_m = TRUE_M + np.array([step_m * i % 200.0 - 100.0, 0.0, 0.0])  # and again over the same ground
        store.put(i, view(shown, PINHOLE, R, at_m))
        match, *_ = node.on(predicted(i, 8.0 if i else 200.0, at_m=at_m, step_m=step_m if i else 0.0))
        assert isinstance(match, MapMatch)
        matches.append(match)
    return matches


@pytest.mark.slow
def test_a_relocalized_place_reports_the_mixture_sigma_until_it_has_passed(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    matches = match_flight(ground, ground, monkeypatch, 6, 18.0)
    source: Any = SingleMapPackage(ground)
    assert matches[0].search.relocalized and matches[0].search.sigma_m == pytest.approx(
        math.sqrt(0.5) * unknown_sigma_m(source)
    )
    assert matches[0].search.sigma_m == mixed_sigma_m(0.5, source)
    assert [m.search.sigma_m for m in matches] == sorted((m.search.sigma_m for m in matches), reverse=True)
    assert matches[1].search.sigma_m > 0.0 and matches[-1].search.sigma_m == 0.0
    assert all(m.verdict is not Verdict.LOST for m in matches)


@pytest.mark.slow
def test_a_wrong_relocalization_is_withdrawn_and_the_whole_map_is_searched(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    matches = match_flight(ground, texture(21, SIDE_M), monkeypatch, 18, STRETCH_M)
    lost = next(i for i, m in enumerate(matches) if m.verdict is Verdict.LOST)
    source: Any = SingleMapPackage(ground)
    assert lost > 0
    assert all(m.search.sigma_m >= 0.2 * unknown_sigma_m(source) for m in matches)  # the reported sigma stays large
    assert matches[lost].search.step is SearchStep.WHOLE_MAP and matches[lost].search.sigma_m == unknown_sigma_m(source)
