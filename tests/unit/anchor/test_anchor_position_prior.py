"""An operator's hint at the anchor: a place to search, a comparison, never a position."""

from typing import Any

import numpy as np
import pytest

from anchor_rig import started
from ground import PINHOLE, texture, view
from one_place import ORIGIN, SIDE_M, TRUE_M, OnlyMap, R, predicted
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.position_prior import SPEED_MPS, CurrentBelief, length, radius_now_m, weigh
from terrafix.anchor.relocalization.relocalizer import PlaceSearch
from terrafix.anchor.verification.lock_monitor import MOST_ODDS, START_ODDS
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

FRAME = LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg)
BOUNDS = (-10_000.0, -10_000.0, 10_000.0, 10_000.0)
KNOWN = CurrentBelief(0.0, 0.0, 10.0, MOST_ODDS)
START = CurrentBelief(0.0, 0.0, 10.0, START_ODDS - 0.1)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


@pytest.mark.parametrize(
    ("believed", "east_m", "radius_m", "searching", "verdict", "begins", "text"),
    [
        (KNOWN, 3000.0, 5000.0, False, Verdict.ACCEPTED, False, "hint agrees, 3.0 km from us"),
        (KNOWN, 8000.0, 5000.0, False, Verdict.INNOVATION, False, "hint not used, 8.0 km from us"),
        (START, 3000.0, 5000.0, False, Verdict.ACCEPTED, False, "hint agrees, 3.0 km from us"),
        (START, 8000.0, 5000.0, False, Verdict.ACCEPTED, True, "hint is 8.0 km off, searching"),
        (KNOWN, 200.0, 5000.0, True, Verdict.ACCEPTED, True, "hint taken, searching within 5.0 km"),
        (CurrentBelief(0.0, 0.0, 400.0, MOST_ODDS), 10.0, 500.0, False, Verdict.ACCEPTED, True, "within 500 m"),
        (KNOWN, 16_000.0, 5000.0, True, Verdict.OUTSIDE_MAP, False, "hint is 6.0 km outside the map"),
        (KNOWN, 14_000.0, 5000.0, True, Verdict.ACCEPTED, True, "searching within"),
    ],
)
def test_what_a_hint_is_worth(
    believed: CurrentBelief, east_m: float, radius_m: float, searching: bool, verdict: Verdict, begins: bool, text: str
) -> None:
    weighed = weigh((east_m, 0.0), radius_m, believed, BOUNDS, searching=searching)
    assert (weighed.verdict, weighed.begins_search) == (verdict, begins)
    assert weighed.distance_m == pytest.approx(east_m)
    assert text in weighed.text and len(weighed.text) <= 40


def test_texts_for_the_pilot_are_never_too_long() -> None:
    for distance in (0.4, 999.6, 9_949.0, 9_951.0, 19_000_000.0):
        assert len(f"hint is {length(distance)} outside the map") <= 40
    assert (length(999.4), length(1000.0), length(9_949.0), length(12_340.0)) == ("999 m", "1.0 km", "9.9 km", "12 km")


def test_an_old_hint_says_less() -> None:
    assert radius_now_m(1000.0, 10.0) == 1000.0 + 10.0 * SPEED_MPS
    assert radius_now_m(1000.0, -1.0) == 1000.0


def hint_at(e_m: float, n_m: float, radius_m: float, t_ns: int = 0) -> PositionHint:
    lat_deg, lon_deg = FRAME.to_wgs84(e_m, n_m)
    return PositionHint(t_ns=t_ns, lat_deg=lat_deg, lon_deg=lon_deg, radius_m=radius_m, source="test")


def said_at(node: AnchorNode, frame_id: int, sigma_m: float = 10.0) -> list[Message]:
    return list(node.on(predicted(frame_id, sigma_m)))


def kinds(said: list[Message]) -> list[type[Message]]:
    return [type(message) for message in said]


def test_a_hint_that_agrees_is_a_comparison_and_changes_nothing(ground: np.ndarray) -> None:
    with_hint, without = started(ground), started(ground)
    for _, frames in (with_hint, without):
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert list(with_hint[0].on(hint_at(120.0, -10.0, 1000.0))) == []
    match, verdict = said_at(with_hint[0], 1)
    assert [match] == said_at(without[0], 1)
    assert isinstance(verdict, HintVerdict)
    assert (verdict.verdict, verdict.hint_t_ns) == (Verdict.ACCEPTED, 0)
    assert verdict.distance_m == pytest.approx(100.0, abs=0.1) and verdict.sigma_m == pytest.approx(10.0)


def test_a_hint_against_a_start_that_nothing_confirmed_begins_a_search_there(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    around: list[Any] = []
    began = MapSearch.__init__

    def begin(self: MapSearch, *arguments: Any) -> None:
        around.append(arguments[3])
        began(self, *arguments)

    monkeypatch.setattr(MapSearch, "__init__", begin)
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    node, frames = started(ground)
    package: Any = OnlyMap
    monkeypatch.setattr(package, "bounds_m", (-3000.0, -3000.0, 3000.0, 3000.0))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    node._watch.odds = START_ODDS - 1.0
    list(node.on(hint_at(1500.0, 0.0, 500.0)))
    match, verdict, state = said_at(node, 1)
    assert isinstance(match, MapMatch) and match.verdict is Verdict.LOST and match.p_c_in_w_m is None
    assert isinstance(verdict, HintVerdict) and "searching" in verdict.text
    assert isinstance(state, SearchState) and state.step is SearchStep.WIDEN
    assert around == [(pytest.approx(1500.0, abs=0.5), pytest.approx(0.0, abs=0.5))]
    assert kinds(said_at(node, 2)) == [MapMatch]  # the step has not changed


def test_the_state_of_the_search_is_said_when_it_changes(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert [m.step for m in said_at(node, 1, 100.0) if isinstance(m, SearchState)] == [SearchStep.WHOLE_MAP]
    monkeypatch.setattr(MapSearch, "step", SearchStep.ASK)
    assert [m.step for m in said_at(node, 2, 100.0) if isinstance(m, SearchState)] == [SearchStep.ASK]
    node._search = PlaceSearch()
    frames.put(3, view(ground, PINHOLE, R, TRUE_M))
    assert [m.step for m in said_at(node, 3) if isinstance(m, SearchState)] == [SearchStep.NORMAL]


def test_a_hint_before_there_is_a_flight_waits_for_it(ground: np.ndarray) -> None:
    package: Any = OnlyMap(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 1.0)
    assert list(node.on(hint_at(0.0, 0.0, 1000.0))) == []
    list(node.on(ORIGIN))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert HintVerdict in kinds(said_at(node, 1))


def test_what_a_search_knows_is_kept_when_the_hint_says_no_more_than_the_map(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    said_at(node, 1, 100.0)
    search = node._search._search
    list(node.on(hint_at(0.0, 0.0, 5000.0)))
    assert [m.verdict for m in said_at(node, 2, 100.0) if isinstance(m, HintVerdict)] == [Verdict.ACCEPTED]
    assert search is not None and node._search._search is search
    list(node.on(hint_at(50.0, 0.0, 150.0)))  # this one does: the map is 400 m wide
    said_at(node, 3, 100.0)
    assert node._search._search is not search
