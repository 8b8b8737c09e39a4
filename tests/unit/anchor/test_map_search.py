"""A search over the whole map: found after several frames at the right place, and never at a wrong one."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from ground import PINHOLE, FlatMap, rotation, texture, view
from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.relocalization.hypothesis_tracker import (
    AHEAD,
    CLEAR_LEAD,
    LEADS,
    LLR_MAX,
    LLR_MIN,
    MIN_FRAMES,
    NEAR,
    NEW_EVIDENCE,
    SPEAKS,
    Found,
    HypothesisTracker,
    PlaceHypothesis,
    _off_sigmas2,
    evidence,
)
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.lock_monitor import MOST_ODDS, LockMonitor, pose_gain
from terrafix.anchor.verification.patch_consensus import PatchConsensus
from terrafix.anchor.verification.patch_null import COARSE, PATCHES, PRIOR_PLACES, PatchNull
from terrafix.map.null_model import USUAL, FlightBudget, NullRow
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import POOL

AGL_M = 100.0
ENOUGH = 10.0  # evidence that a wrong place hardly comes to
SIDE_M = 500.0
STEP_M = np.array([9.0, 12.0])  # 15 m a frame
START_M = np.array([-90.0, -70.0])
HEADING_DEG = 40.0
HEADING_ERROR_DEG = 8.0


class BoundedMap(FlatMap):
    def __init__(self, ground: np.ndarray) -> None:
        super().__init__(ground)
        half_m = len(ground) / 2 * self.gsd_m
        self.bounds_m = (-half_m, -half_m, half_m, half_m)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, SIDE_M)


def frames(ground: np.ndarray, count: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(picture, camera (3,)) along the way."""
    for i in range(count):
        p_m = np.array([*(START_M + i * STEP_M), AGL_M])
        yield view(ground, PINHOLE, rotation(HEADING_DEG), p_m), p_m


def searched(source: BoundedMap, around_m: tuple[float, float] | None, null: NullRow = USUAL) -> MapSearch:
    local: Any = source
    return MapSearch(local, FrameMatcher(PINHOLE, local, GradientDescriber()), AGL_M, around_m, null, FlightBudget())


def predicted() -> View:
    """Somewhere, with a compass that is off."""
    wrong = rotation(HEADING_DEG + HEADING_ERROR_DEG)
    return View(9.0, 9.0, wrong, AGL_M, 0.0, float(np.radians(8.0)), 0.04, float(np.radians(2.0)))


def fly(search: MapSearch, ground: np.ndarray, count: int) -> tuple[Found | None, np.ndarray, int]:
    """-> what was found, where the camera was then, after how many frames."""
    p_m = np.zeros(3)
    for i, (picture, p_m) in enumerate(frames(ground, count)):
        if i:
            search.move(float(STEP_M[0]), float(STEP_M[1]), 1.0)
        found = search.look(picture, predicted())
        if found is not None:
            return found, p_m, i + 1
    return None, p_m, count


def test_a_place_of_which_nothing_is_known_is_found(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    assert search.step is SearchStep.WHOLE_MAP
    found, p_m, after = fly(search, ground, 8)
    assert found is not None and found.fix.pnp.fit is not None
    assert np.linalg.norm(found.fix.pnp.fit.p_c_in_w_m - p_m) < 5.0
    assert np.hypot(found.track.e_m - p_m[0], found.track.n_m - p_m[1]) < 8.0
    assert np.degrees(found.track.hypothesis.yaw_rad) == pytest.approx(HEADING_ERROR_DEG, abs=3.0)
    assert MIN_FRAMES <= after <= 4


def test_one_frame_is_never_enough_however_often_it_is_seen(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    picture, _ = next(frames(ground, 1))
    for _ in range(20):
        assert search.look(picture, predicted()) is None
        search.move(0.0, 0.0, 4.0)  # it hovers, and odometry knows no better
    assert search.tracks.all[0].frames == 1


def test_where_the_best_wrong_places_score_high_more_is_needed_of_the_right_one(ground: np.ndarray) -> None:
    null = msgspec.structs.replace(USUAL, search=msgspec.structs.replace(USUAL.search, above=60.0))
    search = searched(BoundedMap(ground), None, null)
    found, _, after = fly(search, ground, 5)
    assert found is None and after == 5
    assert search.tracks.all[0].odds > searched(BoundedMap(ground), None).enough  # enough on a usual map


def test_every_stretch_of_new_ground_makes_a_find_need_more_and_no_frame_within_it(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HypothesisTracker, "look", lambda *_: None)
    search, needed = searched(BoundedMap(ground), None), list[float]()
    picture, _ = next(frames(ground, 1))
    for _ in range(11):
        search.look(picture, predicted())
        needed.append(search.enough)
        search.move(0.2 * NEW_EVIDENCE * AGL_M, 0.0, 1.0)
    assert needed[0] == needed[4] < needed[5] == needed[9] < needed[10]


def test_what_could_be_the_best_by_chance_grows_with_map_and_headings_and_falls_with_height(
    ground: np.ndarray,
) -> None:
    source, few, many = BoundedMap(ground), (Hypothesis(0.0, 1.0),), 3 * (Hypothesis(0.0, 1.0),)
    search = searched(source, None)
    search._hypotheses = few
    assert search.places == pytest.approx((SIDE_M / (NEAR * AGL_M)) ** 2)
    search._hypotheses = many
    assert search.places == pytest.approx(3.0 * (SIDE_M / (NEAR * AGL_M)) ** 2)
    search.agl_m = 10.0 * SIDE_M
    assert search.places == 3.0  # of a map that is all one place


def test_a_search_begins_with_what_patches_come_to_on_this_map(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None, msgspec.structs.replace(USUAL, patches=(1.5, 2.0)))
    assert search.tracks.chance.patches == pytest.approx((1.5, 2.0))


def test_a_look_is_a_wide_one_once_it_joins_new_ground(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(HypothesisTracker, "look", lambda *_: None)
    search, wide = searched(BoundedMap(ground), None), list[bool]()
    for i, (picture, _) in enumerate(frames(ground, 5)):
        if i:
            search.move(float(STEP_M[0]), float(STEP_M[1]), 1.0)
        search.look(picture, predicted())
        wide.append(search.tracks.all[0].wide)
    assert wide == [False, False, False, False, True]  # 15 m a frame


def test_what_is_not_on_the_map_is_not_found_there() -> None:
    search = searched(BoundedMap(texture(21, SIDE_M)), None)
    assert fly(search, texture(8, SIDE_M), 2)[0] is None


def test_the_search_grows_by_tiles_to_the_whole_map_and_then_asks(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HypothesisTracker, "look", lambda *_: None)  # nobody is found
    monkeypatch.setattr("terrafix.anchor.relocalization.map_search.FINE_HYPOTHESES", 0)  # pooled cells are faster
    monkeypatch.setattr("terrafix.anchor.relocalization.block_search.BLOCK_CELLS", 12)
    monkeypatch.setattr("terrafix.anchor.relocalization.map_search.BLOCK_CELLS", 12)
    search = searched(BoundedMap(ground), START_M.tolist())
    picture, _ = next(frames(ground, 1))
    said: list[tuple[SearchStep, int]] = []
    while search.step is not SearchStep.ASK:
        assert search.look(picture, predicted()) is None
        if (search.step, search.tiles) not in said:
            said.append((search.step, search.tiles))
        search.move(0.0, 100.0, 1.0)
        assert len(said) < 20
    tiles = [n for step, n in said if step is SearchStep.WIDEN]
    assert tiles == [4, 9, 16, 25]  # what follows the look at the first one, and so on
    assert [step for step, _ in said[4:]] == [SearchStep.WHOLE_MAP, SearchStep.ASK]
    assert said[-1][1] == said[-2][1] > 25


def test_an_unknown_heading_or_a_large_map_is_searched_on_pooled_cells(ground: np.ndarray) -> None:
    def stride(side_m: float, yaw_sigma_deg: float) -> int:
        source = BoundedMap(ground)
        source.bounds_m = (-side_m / 2, -side_m / 2, side_m / 2, side_m / 2)
        search = searched(source, None)
        search._begin(replace(predicted(), yaw_sigma_rad=float(np.radians(yaw_sigma_deg))))
        return search._wide.stride

    assert stride(1000.0, 8.0) == 1
    assert stride(1000.0, 180.0) == stride(10_000.0, 8.0) == POOL


def test_a_way_that_nobody_saw_ends_the_tracks(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    search.tracks.propose(0.0, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    search.move(20.0, 0.0, 0.3 * AGL_M)
    assert len(search.tracks.all) == 1
    search.move(20.0, 0.0, 0.5 * AGL_M)
    assert not search.tracks.all


def test_odometry_moves_a_track() -> None:
    track = PlaceHypothesis(10.0, 20.0, Hypothesis(0.0, 1.0))
    track.moved(np.array([3.0, -4.0]))
    assert (track.e_m, track.n_m) == (13.0, 16.0)


def test_a_track_moves_by_its_own_heading_and_height() -> None:
    """Odometry tells steps as the predicted heading and height have them; a search has others."""
    track = PlaceHypothesis(10.0, 20.0, Hypothesis(np.pi / 2, 1.5))
    track.moved(np.array([4.0, 0.0]))  # east, and a quarter turn counter-clockwise of that is north
    assert (track.e_m, track.n_m) == pytest.approx((10.0, 26.0))


def test_a_proposal_near_a_track_replaces_it_until_a_frame_has_spoken_for_it(ground: np.ndarray) -> None:
    tracks = searched(BoundedMap(ground), None).tracks
    for e_m in (0.0, 0.15 * AGL_M):
        tracks.propose(e_m, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert [t.e_m for t in tracks.all] == [0.15 * AGL_M]
    tracks.all[0].score = 1.0
    tracks.propose(0.0, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert [t.e_m for t in tracks.all] == [0.15 * AGL_M]
    tracks.propose(-0.1 * AGL_M, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert len(tracks.all) == 2


def test_the_next_row_of_houses_is_followed_too(ground: np.ndarray) -> None:
    """The best place of a look has a lesser one beside it: both are tracks, and lead other places."""
    search = searched(BoundedMap(ground), None)
    picture, _ = next(frames(ground, 1))
    search.look(picture, predicted())
    search.tracks.all = []
    z = np.zeros(search._shape, np.float32)
    row, column = (side // 2 for side in search._shape)
    beside = round(0.3 * AGL_M / search._cell_m)
    z[row, column], z[row, column + beside], z[row + 3 * beside, column] = 9.0, 8.0, 5.0
    search._judge(z, np.zeros(search._shape, np.uint8), AGL_M)
    best, second = sorted(search.tracks.all, key=lambda t: -t.leads[-1])[:2]
    assert second.e_m - best.e_m == pytest.approx(0.3 * AGL_M, abs=search._cell_m)
    assert best.leads[-1] == pytest.approx(9.0 - 5.0)
    assert second.leads[-1] == pytest.approx(8.0 - 5.0 - (9.0 - 8.0))


def track_of(
    score: float, leads: tuple[float, ...] = (), frames: int = MIN_FRAMES, e_m: float = 0.0, *, wide: bool = False
) -> PlaceHypothesis:
    return PlaceHypothesis(e_m, 0.0, Hypothesis(0.0, 1.0), score, frames, leads=leads, wide=wide)


@pytest.mark.parametrize(
    ("best", "rivals", "found"),
    [
        (track_of(ENOUGH + 0.1), [], True),
        (track_of(ENOUGH - 0.1), [], False),
        (track_of(ENOUGH + 0.1, frames=MIN_FRAMES - 1), [], False),
        (track_of(ENOUGH + 0.1, leads=(2.0,), frames=MIN_FRAMES - 1, wide=True), [], True),  # the look is the other
        (track_of(ENOUGH + 0.1, leads=(2.0,), frames=0, wide=True), [], False),  # looks alone never do
        (track_of(LLR_MIN, leads=(5.0, 5.0), frames=0), [], False),
        (track_of(ENOUGH - 2.0, leads=(1.0, 1.0)), [], True),
        (track_of(ENOUGH - 2.0, leads=(9.0,)), [], False),  # one look may be chance
        (track_of(ENOUGH - 2.0, leads=(9.0, -1.0)), [], False),
        (track_of(ENOUGH + 4.0), [track_of(ENOUGH, e_m=200.0)], False),  # the ground repeats
        (track_of(ENOUGH + AHEAD + 0.1), [track_of(ENOUGH, e_m=200.0)], True),
    ],
)
def test_what_is_found_has_enough_and_is_ahead(
    ground: np.ndarray, best: PlaceHypothesis, rivals: list[PlaceHypothesis], found: bool
) -> None:
    tracks = searched(BoundedMap(ground), None).tracks
    tracks.all = [best, *rivals]
    assert tracks._is_found(best, ENOUGH) is found


def test_one_piece_of_ground_counts_once() -> None:
    """However many frames show it; and what speaks against a place does so once."""
    track = PlaceHypothesis(0.0, 0.0, Hypothesis(0.0, 1.0))
    for i in range(11):
        track.checked(LLR_MAX, i * 0.1 * NEW_EVIDENCE * AGL_M, AGL_M)
    assert track.score == pytest.approx(2.0 * LLR_MAX) and track.frames == 11
    for i in range(30):
        track.checked(LLR_MIN, (1 + i) * NEW_EVIDENCE * AGL_M, AGL_M)
    assert track.score == LLR_MIN


def test_a_frame_that_says_next_to_nothing_does_not_speak_for_a_place() -> None:
    track = PlaceHypothesis(0.0, 0.0, Hypothesis(0.0, 1.0))
    track.checked(SPEAKS - 0.1, 0.0, AGL_M)
    assert track.score > 0.0 and track.frames == 0
    track.checked(SPEAKS + 0.1, AGL_M, AGL_M)
    assert track.frames == 1


def test_a_lead_counts_once_it_has_lasted() -> None:
    track = track_of(0.0)
    assert track.lead == track.odds == 0.0
    track.looked_at(4.0, wide=False)
    assert track.lead == 0.0
    track.looked_at(1.0, wide=False)
    assert track.lead == 1.0 < track.odds
    track.looked_at(-2.0, wide=False)
    assert track.lead == -2.0 and track.odds < 0.0 and len(track.leads) == LEADS


def test_a_lead_in_a_wide_look_counts_at_once_and_as_a_witness() -> None:
    track = track_of(ENOUGH)
    track.frames = 1
    track.looked_at(CLEAR_LEAD, wide=False)
    track.looked_at(CLEAR_LEAD, wide=False)
    assert (track.lead, track.witnesses) == (CLEAR_LEAD, 1)
    track.looked_at(2.0, wide=True)
    assert (track.lead, track.witnesses) == (2.0, 2)
    track.looked_at(CLEAR_LEAD - 0.1, wide=True)
    assert track.witnesses == 1


def test_a_heading_and_a_height_that_are_as_predicted_speak_for_a_place_and_others_against_it() -> None:
    track, view = track_of(0.0), replace(predicted(), yaw_sigma_rad=0.1, scale_sigma=0.1)
    assert track.odds == 0.0  # nothing is known yet
    for hypothesis, speaks in (
        (Hypothesis(0.0, 1.0), True),
        (Hypothesis(0.35, 1.0), False),
        (Hypothesis(0.0, 0.7), False),
    ):
        track.off_sigmas2 = _off_sigmas2(hypothesis, view)
        assert (track.odds > 0.0) is speaks
    known = replace(view, yaw_sigma_rad=0.0, scale_sigma=0.0)
    assert 1.0 < _off_sigmas2(Hypothesis(0.1, 1.0), known) < 2.0  # patches leave some degrees open


def of(llr: float, patches: int = PATCHES) -> PatchConsensus:
    return PatchConsensus(llr, np.zeros(6), np.zeros((patches, 2)), np.zeros(patches, bool))


def test_what_chance_comes_to_is_no_evidence() -> None:
    chance, by_chance = PatchNull(), COARSE[0]

    def gain(llr: float, patches: int) -> float:
        return evidence(chance.sigmas(of(llr, patches), fine=False))

    assert gain(by_chance, PATCHES) == LLR_MIN < 0.0 < gain(2.0 * by_chance, PATCHES)
    assert gain(40.0, PATCHES) == LLR_MAX
    assert gain(0.25 * by_chance, PATCHES // 4) < 0.0  # fewer patches: by chance they come to less, too
    assert gain(by_chance, PATCHES // 4) > gain(by_chance, PATCHES)


def test_ground_that_repeats_has_to_say_more() -> None:
    """What its wrong places come to is chance there, on cells of either kind."""
    chance = PatchNull()
    before = chance.sigmas(of(16.0), fine=True)
    for llr in np.random.default_rng(1).normal(12.0, 2.7, 200):
        chance.learn(of(float(llr)), fine=True)
        chance.learn(of(60.0, PATCHES // 2), fine=True)  # half of them beyond the map
    assert before > 2.5 and chance.sigmas(of(16.0), fine=True) == pytest.approx(1.55, abs=0.3)
    assert chance.sigmas(of(16.0), fine=False) < PatchNull().sigmas(of(16.0), fine=False) - 1.0


def test_a_place_without_rivals_is_weighed_against_places_that_are_none(ground: np.ndarray) -> None:
    tracks, (picture, p_m) = searched(BoundedMap(ground), None).tracks, next(frames(ground, 1))
    for k, e_m in enumerate((0.0, -0.5, 0.5, -1.0)):
        tracks.propose(float(p_m[0]) + e_m * AGL_M, float(p_m[1]), Hypothesis(0.0, 1.0), AGL_M)
        tracks.all[-1].looked_at(-9.0 if k else 2.0, wide=False)
    tracks.look(picture, predicted(), 0.0, ENOUGH)
    assert len(tracks.all) == 1 and tracks.chance._sums[0] == PRIOR_PLACES + 3.0
    assert not tracks.chance.is_known


def test_more_patches_say_more() -> None:
    assert pose_gain(7) == 0.0 < pose_gain(8) < pose_gain(12) < pose_gain(20) == pose_gain(48)


# --- whether a place is still believed ----------------------------------------------------------------


def test_a_start_that_nothing_speaks_for_is_given_up_after_some_looks() -> None:
    watch = LockMonitor()
    looks = 0
    while not watch.lost:
        watch.looked(0.6, 1.0, 1.0, 0, 10.0, AGL_M)
        looks += 1
    assert 12 <= looks <= 20


@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_looks_at_the_right_place_keep_it(weight: float) -> None:
    """Without a single pose: what the frames say for the belief is enough."""
    watch = LockMonitor()
    for _ in range(200):
        watch.looked(4.0 * weight, weight, weight, 0, 10.0, AGL_M)
        assert not watch.lost


def test_poses_carry_over_ground_without_texture_but_not_for_ever() -> None:
    watch = LockMonitor()
    for _ in range(60):
        watch.looked(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    assert watch.odds == MOST_ODDS
    poor = 0
    while not watch.lost:
        watch.looked(-3.0, 1.0, 1.0, 0, 10.0, AGL_M)
        poor += 1
    assert 40 <= poor <= 60


def test_looks_at_one_field_say_nothing_against_it() -> None:
    watch = LockMonitor()
    for _ in range(300):
        watch.looked(-0.2, 0.08, 0.0, 0, 10.0, AGL_M)
    assert not watch.lost and watch.doubt == 0.0


def test_doubt_is_a_probability_and_begins_when_the_ellipse_would_not_hold() -> None:
    watch = LockMonitor()
    assert watch.doubt == 0.0
    said = []
    while not watch.lost:
        watch.looked(0.0, 0.5, 0.5, 0, 10.0, AGL_M)
        said.append(watch.doubt)
    first = next(doubt for doubt in said if doubt)
    assert said[0] == 0.0 and 0.05 <= first < 0.07 and said == sorted(said) and said[-1] > 0.5


def test_a_position_that_claims_little_is_not_given_up() -> None:
    watch = LockMonitor()
    for _ in range(60):
        watch.looked(-3.0, 1.0, 1.0, 0, 80.0, AGL_M)
    assert not watch.lost


def test_a_way_that_nobody_saw_leaves_no_more_than_a_start() -> None:
    watch = LockMonitor()
    for _ in range(60):
        watch.looked(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    watch.looked(0.0, 1.0, 1.0, 0, 80.0, AGL_M)
    assert watch.odds == LockMonitor().odds
