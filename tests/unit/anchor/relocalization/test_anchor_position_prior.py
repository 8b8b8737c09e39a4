"""Position prior (operator's hint) at the anchor: it starts a search or is compared, and is never fused."""

from typing import Any

import numpy as np
import pytest

from anchor_rig import started
from single_map_place import ORIGIN, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.position_prior import (
    RADIUS_GROWTH_MPS,
    CurrentBelief,
    aged_radius_m,
    distance_text,
    evaluate_prior,
)
from terrafix.anchor.relocalization.relocalizer import Relocalizer
from terrafix.anchor.verification.lock_monitor import MAX_LOG_ODDS, START_LOG_ODDS
from terrafix.core.agreement import Cause
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import (
    HintVerdict,
    MapMatch,
    Message,
    PositionHint,
    SearchState,
    SearchStep,
    Verdict,
)
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, view

FRAME = LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg)
BOUNDS = (-10_000.0, -10_000.0, 10_000.0, 10_000.0)
KNOWN = CurrentBelief(0.0, 0.0, 10.0, MAX_LOG_ODDS)
START = CurrentBelief(0.0, 0.0, 10.0, START_LOG_ODDS - 0.1)


@pytest.mark.parametrize(
    ("belief", "east_m", "radius_m", "searching", "verdict", "begins", "text"),
    [
        (KNOWN, 3000.0, 5000.0, False, Verdict.ACCEPTED, False, "hint agrees, 3.0 km from the estimate"),
        (KNOWN, 8000.0, 5000.0, False, Verdict.INNOVATION, False, "hint not used, 8.0 km from the estimate"),
        (START, 3000.0, 5000.0, False, Verdict.ACCEPTED, False, "hint agrees, 3.0 km from the estimate"),
        (START, 8000.0, 5000.0, False, Verdict.ACCEPTED, True, "hint is 8.0 km off, searching"),
        (KNOWN, 200.0, 5000.0, True, Verdict.ACCEPTED, True, "hint accepted, searching within 5.0 km"),
        (CurrentBelief(0.0, 0.0, 400.0, MAX_LOG_ODDS), 10.0, 500.0, False, Verdict.ACCEPTED, True, "within 500 m"),
        (KNOWN, 16_000.0, 5000.0, True, Verdict.OUTSIDE_MAP, False, "hint is 6.0 km outside the map"),
        (KNOWN, 14_000.0, 5000.0, True, Verdict.ACCEPTED, True, "searching within"),
    ],
)
def test_verdict_of_a_position_prior(
    belief: CurrentBelief, east_m: float, radius_m: float, searching: bool, verdict: Verdict, begins: bool, text: str
) -> None:
    decision = evaluate_prior((east_m, 0.0), radius_m, belief, BOUNDS, searching=searching)
    assert (decision.verdict, decision.starts_search) == (verdict, begins)
    assert decision.distance_m == pytest.approx(east_m)
    assert text in decision.text and len(decision.text) <= 40


def test_pilot_texts_have_at_most_40_characters() -> None:
    for distance in (0.4, 999.6, 9_949.0, 9_951.0, 19_000_000.0):
        assert len(f"hint is {distance_text(distance)} outside the map") <= 40
    assert (distance_text(999.4), distance_text(1000.0), distance_text(9_949.0), distance_text(12_340.0)) == (
        "999 m",
        "1.0 km",
        "9.9 km",
        "12 km",
    )


def test_the_radius_of_a_prior_grows_with_its_age() -> None:
    assert aged_radius_m(1000.0, 10.0) == 1000.0 + 10.0 * RADIUS_GROWTH_MPS
    assert aged_radius_m(1000.0, -1.0) == 1000.0


def hint_at(e_m: float, n_m: float, radius_m: float, t_ns: int = 0) -> PositionHint:
    lat_deg, lon_deg = FRAME.to_wgs84(e_m, n_m)
    return PositionHint(t_ns=t_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=radius_m, source="test")


def messages_after(node: AnchorNode, frame_id: int, sigma_m: float = 10.0) -> list[Message]:
    return list(node.on(predicted(frame_id, sigma_m)))


def types_of(messages: list[Message]) -> list[type[Message]]:
    return [type(message) for message in messages]


def test_a_prior_that_agrees_changes_nothing(ground: np.ndarray) -> None:
    with_hint, without = started(ground), started(ground)
    for _, frames in (with_hint, without):
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert list(with_hint[0].on(hint_at(120.0, -10.0, 1000.0))) == []
    match, verdict = messages_after(with_hint[0], 1)
    assert [match] == messages_after(without[0], 1)
    assert isinstance(verdict, HintVerdict)
    assert (verdict.verdict, verdict.hint_t_ns) == (Verdict.ACCEPTED, 0)
    assert verdict.distance_m == pytest.approx(100.0, abs=0.1) and verdict.sigma_m == pytest.approx(10.0)


def test_a_prior_against_an_unconfirmed_start_starts_a_search_there(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    around: list[Any] = []
    began = MapSearch.__init__

    def begin(self: MapSearch, *arguments: Any) -> None:
        around.append(arguments[3])
        began(self, *arguments)

    monkeypatch.setattr(MapSearch, "__init__", begin)
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    node, frames = started(ground)
    package: Any = SingleMapPackage
    monkeypatch.setattr(package, "bounds_m", (-3000.0, -3000.0, 3000.0, 3000.0))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    node._localizer._lock_monitor.agreement.begin(Cause.ELSEWHERE, -(START_LOG_ODDS - 1.0))
    list(node.on(hint_at(1500.0, 0.0, 500.0)))
    match, verdict, state = messages_after(node, 1)
    assert isinstance(match, MapMatch) and match.verdict is Verdict.LOST and match.pose is None
    assert isinstance(verdict, HintVerdict) and "searching" in verdict.text
    assert isinstance(state, SearchState) and state.step is SearchStep.WIDEN
    assert around == [(pytest.approx(1500.0, abs=0.5), pytest.approx(0.0, abs=0.5))]
    assert types_of(messages_after(node, 2)) == [MapMatch]  # the step has not changed


def test_the_search_state_is_published_when_it_changes(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert [m.step for m in messages_after(node, 1, 100.0) if isinstance(m, SearchState)] == [SearchStep.WHOLE_MAP]
    monkeypatch.setattr(MapSearch, "step", SearchStep.ASK)
    assert [m.step for m in messages_after(node, 2, 100.0) if isinstance(m, SearchState)] == [SearchStep.ASK]
    node._localizer._relocalizer = Relocalizer()
    frames.put(3, view(ground, PINHOLE, R, TRUE_M))
    assert [m.step for m in messages_after(node, 3) if isinstance(m, SearchState)] == [SearchStep.NORMAL]


def test_a_prior_before_the_origin_is_applied_with_the_first_prediction(ground: np.ndarray) -> None:
    package: Any = SingleMapPackage(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    assert list(node.on(hint_at(0.0, 0.0, 1000.0))) == []
    list(node.on(ORIGIN))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert HintVerdict in types_of(messages_after(node, 1))


def test_a_prior_as_wide_as_the_map_does_not_restart_a_search(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    messages_after(node, 1, 100.0)
    search = node._localizer._relocalizer._search
    list(node.on(hint_at(0.0, 0.0, 5000.0)))
    assert [m.verdict for m in messages_after(node, 2, 100.0) if isinstance(m, HintVerdict)] == [Verdict.ACCEPTED]
    assert search is not None and node._localizer._relocalizer._search is search
    list(node.on(hint_at(50.0, 0.0, 150.0)))  # narrower than the map, which is 400 m wide
    messages_after(node, 3, 100.0)
    assert node._localizer._relocalizer._search is not search
