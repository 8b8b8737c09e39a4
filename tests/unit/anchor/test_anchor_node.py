"""What the anchor says when it is lost, or was never anywhere."""

from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from anchor_rig import started
from ground import PINHOLE, texture, view
from one_place import AGL_M, ORIGIN, SIDE_M, TRUE_M, OnlyMap, R, predicted
from terrafix.anchor.matching.frame_matcher import FrameMatcher
from terrafix.anchor.matching.match_message import ground_sigma_m
from terrafix.anchor.matching.point_mass_filter import Belief
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.relocalization.relocalizer import LOST_SIGMA_M, start_around
from terrafix.anchor.verification.consensus_pose import ConsensusPose
from terrafix.anchor.verification.lock_monitor import LockMonitor
from terrafix.core.frames import MemoryFrameStore
from terrafix.map.null_model import USUAL, VERSION, NullModel
from terrafix.messages import MapMatch, SearchState, SearchStep, Verdict
from terrafix_engines.features.gradient import GradientDescriber

CELL_M = 2.0  # of a belief


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


def match(node: AnchorNode, frame_id: int, sigma_m: float, at_m: np.ndarray = TRUE_M, step_m: float = 0.0) -> MapMatch:
    answer, *_ = node.on(predicted(frame_id, sigma_m, at_m=at_m, step_m=step_m))
    assert isinstance(answer, MapMatch)
    return answer


def test_a_place_that_is_right_is_tracked(ground: np.ndarray) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    said = match(node, 1, 10.0)
    assert said.verdict is Verdict.ACCEPTED and not said.coarse and not said.found
    assert (said.step, said.lost_sigma_m) == (SearchStep.NORMAL, 0.0)


def test_where_no_patch_finds_its_spot_alone_all_of_them_together_give_the_pose(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And do not count as a confirmation, which would keep a wrong place for long."""
    heard = list[int]()
    monkeypatch.setattr(FrameMatcher, "fix", lambda *_: None)
    monkeypatch.setattr(LockMonitor, "looked", lambda _self, _gain, _weight, _new, inliers, *_: heard.append(inliers))
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    said = match(node, 1, 10.0)
    assert said.verdict is Verdict.ACCEPTED and not said.coarse and said.p_c_in_w_m is not None
    assert np.linalg.norm(np.array(said.p_c_in_w_m) - TRUE_M) < 3.0
    assert heard == [0]
    monkeypatch.setattr(ConsensusPose, "at", lambda *_: None)  # and without these the place of the belief remains
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 2, 10.0).coarse


@pytest.mark.parametrize(("sigma_m", "asked"), [(0.019 * AGL_M, False), (0.021 * AGL_M, True)])
def test_a_pose_of_single_patches_that_claims_little_is_one_of_all_patches(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch, sigma_m: float, asked: bool
) -> None:
    heard, together = list[bool](), ConsensusPose.at
    monkeypatch.setattr("terrafix.anchor.node.ground_sigma_m", lambda *_: sigma_m)
    monkeypatch.setattr(ConsensusPose, "at", lambda *of: heard.append(True) or together(*of))
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    said = match(node, 1, 10.0)
    assert said.verdict is Verdict.ACCEPTED and not said.coarse
    assert np.linalg.norm(np.array(said.p_c_in_w_m) - TRUE_M) < 3.0
    assert bool(heard) is asked
    monkeypatch.setattr(ConsensusPose, "at", lambda *_: None)  # where these say nothing the first one stays
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    assert not match(node, 2, 10.0).coarse


def test_what_tilt_and_position_trade_does_not_move_the_ground_that_is_seen() -> None:
    lever = np.zeros((6, 1))
    lever[0], lever[4] = AGL_M, 1.0  # east, and as much about north as takes the ground back
    cov = np.diag([4.0, 1.0, 9.0, 1e-12, 1e-12, 1e-4]) + lever @ lever.T * np.radians(10.0) ** 2
    said = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="", cov=tuple(cov.ravel()))
    assert ground_sigma_m(said, AGL_M) == pytest.approx(2.0, abs=1e-3)
    assert ground_sigma_m(msgspec.structs.replace(said, cov=None), AGL_M) == np.inf


def test_an_unusable_picture_is_skipped(ground: np.ndarray) -> None:
    node, _ = started(ground)
    said = match(node, 1, 10.0)
    assert (said.verdict, said.step) == (Verdict.BAD_IMAGE, SearchStep.SKIP)


def test_a_start_that_is_not_known_is_searched_on_the_whole_map(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    said = match(node, 1, 100.0)
    assert (said.verdict, said.step, said.lost_sigma_m) == (Verdict.LOST, SearchStep.WHOLE_MAP, LOST_SIGMA_M)
    assert said.p_c_in_w_m is None and said.cov is None and not said.found


def test_a_search_needs_what_the_map_says_of_its_wrong_places(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed = list[float]()
    monkeypatch.setattr(MapSearch, "look", lambda search, *_: needed.append(search.enough))
    rows = tuple(
        msgspec.structs.replace(USUAL, agl_m=agl_m, search=msgspec.structs.replace(USUAL.search, above=above))
        for agl_m, above in ((0.5 * AGL_M, 1e3), (1.1 * AGL_M, 50.0))
    )
    layer = SimpleNamespace(
        table="imagery",
        ce90_m=None,
        ce90_origin=None,
        null_model=NullModel(version=VERSION, matcher="gradient", rows=rows),
    )
    for manifest in (OnlyMap.manifest, SimpleNamespace(layers=(layer,))):
        monkeypatch.setattr(OnlyMap, "manifest", manifest)
        node, frames = started(ground, 5000.0)
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
        match(node, 1, 100.0)
    assert needed[0] < 20.0
    assert needed[1] == pytest.approx(needed[0] + 50.0 - USUAL.search.above)


def test_a_search_joins_frames_by_their_steps_however_the_unknown_place_grows_worse(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A heading that is known to ten degrees makes it worse by metres a frame; a search tries the headings itself."""
    steps_m = list[float]()
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    monkeypatch.setattr(MapSearch, "move", lambda _self, _east, _north, sigma_m: steps_m.append(sigma_m))
    node, frames = started(ground, 5000.0)
    for i, sigma_m in enumerate((100.0, 100.5, 101.0)):
        frames.put(i, view(ground, PINHOLE, R, TRUE_M))
        list(node.on(predicted(i, sigma_m, step_sigma_m=1.0, step_m=10.0)))
    assert steps_m == [1.0, 1.0]


def test_an_anchor_that_starts_again_in_flight_does_not_search_what_was_found(ground: np.ndarray) -> None:
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 1, 10.0).verdict is Verdict.ACCEPTED


def test_a_hint_is_searched_from_where_it_points_unless_it_says_no_more_than_the_map(ground: np.ndarray) -> None:
    source: Any = OnlyMap(ground)
    source.bounds_m = (-4000.0, -1000.0, 4000.0, 1000.0)
    assert start_around(30.0, 40.0, 1500.0, source) == (30.0, 40.0)
    assert start_around(30.0, 40.0, 2500.0, source) is None


def test_a_place_that_nothing_speaks_for_is_withdrawn_and_said(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    monkeypatch.setattr(LockMonitor, "lost", True)
    said = match(node, 1, 10.0)
    assert (said.verdict, said.step, said.lost_sigma_m) == (Verdict.LOST, SearchStep.WIDEN, LOST_SIGMA_M)
    assert said.matches == [] and said.p_c_in_w_m is None
    assert match(node, 2, 10.0).verdict is Verdict.LOST  # also without a picture


def test_every_step_of_the_escalation_is_said(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    node, frames = started(ground)
    picture = view(ground, PINHOLE, R, TRUE_M)
    said: list[SearchStep] = []

    def fly(frame_id: int, image: np.ndarray | None, step_sigma_m: float = 1.0) -> None:
        if image is not None:
            frames.put(frame_id, image)
        said.extend(
            m.step for m in node.on(predicted(frame_id, 10.0, step_sigma_m=step_sigma_m)) if isinstance(m, SearchState)
        )

    fly(1, picture)
    fly(2, None)
    fly(3, picture)
    fly(4, picture, step_sigma_m=60.0)
    fly(5, picture)
    fly(6, picture)
    assert said == [
        SearchStep.SKIP,
        SearchStep.NORMAL,
        SearchStep.NEW_FRAGMENT,
        SearchStep.MERGE,
        SearchStep.NORMAL,
    ]
    said.clear()
    with monkeypatch.context() as patched:
        patched.setattr(LockMonitor, "lost", True)
        patched.setattr(MapSearch, "look", lambda *_: None)
        fly(7, picture)
        patched.setattr(MapSearch, "step", SearchStep.ASK)
        fly(8, picture)
    assert said == [SearchStep.WIDEN, SearchStep.ASK]


@pytest.mark.parametrize(("heading_sigma_rad", "spreads"), [(0.03, False), (3.0, True)])
def test_without_a_heading_a_step_leads_anywhere(ground: np.ndarray, heading_sigma_rad: float, spreads: bool) -> None:
    node, _ = started(ground)
    for frame_id, step_m in ((1, 0.0), (2, 30.0)):
        said = predicted(frame_id, 10.0, step_m=step_m)
        list(node.on(msgspec.structs.replace(said, cov=(*said.cov[:35], heading_sigma_rad**2))))
    belief = node._belief
    assert belief is not None and (np.sqrt(belief.covariance()[2]) > 25.0) == spreads


@pytest.mark.parametrize(("heading_sigma_rad", "tried"), [(0.03, False), (3.0, True)])
def test_without_a_heading_a_pose_is_tried_at_any_mode(
    ground: np.ndarray, heading_sigma_rad: float, tried: bool
) -> None:
    node, frames = started(ground)
    said = predicted(1, 10.0)
    said = msgspec.structs.replace(said, cov=(*said.cov[:35], heading_sigma_rad**2))
    list(node.on(said))  # the belief begins
    node._belief = Belief(float(TRUE_M[0]), float(TRUE_M[1]), 80.0, CELL_M)
    node._since_look_m = 0.0  # ground that was just seen counts little
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    answer, *_ = node.on(msgspec.structs.replace(said, frame_id=2))
    assert isinstance(answer, MapMatch) and answer.verdict is Verdict.AMBIGUOUS
    assert (answer.inliers > 0) == tried


def test_a_search_goes_on_along_chosen_axes(ground: np.ndarray) -> None:
    """Its places move by their own headings: what the position owes to the heading says nothing of the step."""
    node, frames = started(ground, start_sigma_m=500.0)
    for frame_id, sigma_m in ((1, 500.0), (2, 600.0)):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        said = predicted(frame_id, sigma_m, step_m=5.0)
        list(node.on(msgspec.structs.replace(said, cov=(*said.cov[:35], 9.0))))
    assert not node._torn


def test_another_flight_begins_with_nothing_of_the_last_one(ground: np.ndarray) -> None:
    node, frames = started(ground)
    fresh = vars(started(ground)[0])
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    match(node, 1, 10.0)
    node._poor_looks = 3.0
    list(node.on(msgspec.structs.replace(ORIGIN, t_ns=1)))
    for name in ("_belief", "_since_look_m", "_poor_looks", "_variance_m2", "_torn", "_apart"):
        assert vars(node)[name] == fresh[name], name


class TwoDates:
    """The newest layer shows other ground, as after building works; the older one is right, and states its accuracy."""

    manifest = SimpleNamespace(
        layers=tuple(
            SimpleNamespace(table=table, ce90_m=ce90_m, ce90_origin=None, null_model=None)
            for table, ce90_m in (("new", None), ("old", 5.0))
        )
    )

    def __init__(self, ground: np.ndarray) -> None:
        self._maps = {"new": OnlyMap(texture(77, SIDE_M)), "old": OnlyMap(ground)}

    def bind(self, _frame: object, layer: str) -> OnlyMap:
        return self._maps[layer]


def test_the_layer_that_fits_is_learnt(ground: np.ndarray) -> None:
    package: Any = TwoDates(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 10.0)
    list(node.on(ORIGIN))
    said = []
    for frame_id in range(1, 9):
        at_m = TRUE_M + np.array([15.0 * (frame_id - 4), 0.0, 0.0])
        frames.put(frame_id, view(ground, PINHOLE, R, at_m))
        said.append(match(node, frame_id, 10.0, at_m, step_m=15.0 if frame_id > 1 else 0.0))
    assert said[0].verdict is not Verdict.ACCEPTED and said[0].map_sigma_m == pytest.approx(10.0 / 2.146)
    assert [m.verdict for m in said[-2:]] == [Verdict.ACCEPTED] * 2
    assert said[-1].map_sigma_m == pytest.approx(5.0 / 2.146)
    assert said[-1].p_c_in_w_m is not None and np.hypot(*(np.array(said[-1].p_c_in_w_m) - at_m)[:2]) < 3.0


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "searches"), [(4000.0, 1400.0, True), (4000.0, 1300.0, False), (50.0, 30.0, False)]
)
def test_a_flight_that_dead_reckoning_has_led_off_the_map_is_searched_where_it_may_be_on_it(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch, off_m: float, sigma_m: float, searches: bool
) -> None:
    monkeypatch.setattr(MapSearch, "look", lambda *_: None)
    node, frames = started(ground)
    assert node._layers is not None
    e_max = node._layers.best.map.bounds_m[2]
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    match(node, 1, 10.0)
    away = np.array([e_max + off_m, TRUE_M[1], TRUE_M[2]])
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    said = match(node, 2, sigma_m, at_m=away, step_m=float(away[0] - TRUE_M[0]))
    assert (said.verdict is Verdict.LOST) == searches
    assert node._search.is_on == searches
