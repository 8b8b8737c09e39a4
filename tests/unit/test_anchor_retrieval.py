"""A search over the whole map: found after several frames at the right place, and never at a wrong one."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from ground import PINHOLE, FlatMap, rotation, texture, view

from terrafix.anchor.lost import MOST_ODDS, LostWatch
from terrafix.anchor.matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.retrieval import LOOK_EVERY, MapSearch
from terrafix.anchor.tracks import ENOUGH, LEADS, NEEDED, Found, Track, Tracks, pose_gain
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import POOL

AGL_M = 100.0
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


def searched(source: BoundedMap, around_m: tuple[float, float] | None) -> MapSearch:
    return MapSearch(source, FrameMatcher(PINHOLE, source, GradientDescriber()), AGL_M, around_m)  # type: ignore[arg-type]


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
    # Never on one frame: it takes a second joint look, over new ground.
    assert (after - 1) * float(np.hypot(*STEP_M)) >= LOOK_EVERY * AGL_M


def test_one_frame_is_never_enough_however_often_it_is_seen(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    picture, _ = next(frames(ground, 1))
    for _ in range(2):
        assert search.look(picture, predicted()) is None
        search.move(0.0, 0.0, 4.0)  # nothing says how far it went


def test_what_is_not_on_the_map_is_not_found_there() -> None:
    search = searched(BoundedMap(texture(21, SIDE_M)), None)
    assert fly(search, texture(8, SIDE_M), 2)[0] is None


def test_the_search_grows_by_tiles_to_the_whole_map_and_then_asks(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tracks, "look", lambda *_: None)  # nobody is found
    monkeypatch.setattr("terrafix.anchor.retrieval.FINE_HYPOTHESES", 0)  # pooled cells are faster
    monkeypatch.setattr("terrafix.anchor.wide_search.BLOCK_CELLS", 12)
    monkeypatch.setattr("terrafix.anchor.retrieval.BLOCK_CELLS", 12)
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


def test_odometry_moves_a_track_and_its_last_pose() -> None:
    track = Track(10.0, 20.0, Hypothesis(0.0, 1.0), last_p_m=np.array([12.0, 19.0]))
    track.moved(np.array([3.0, -4.0]))
    assert (track.e_m, track.n_m) == (13.0, 16.0) and track.last_p_m is not None
    assert track.last_p_m.tolist() == [15.0, 15.0]


def track_of(leads: tuple[float, ...], poses: int, span_m: float, score: float = 20.0) -> Track:
    return Track(0.0, 0.0, Hypothesis(0.0, 1.0), score, poses, 0.0, span_m, leads=leads)


@pytest.mark.parametrize(
    ("leads", "poses", "span_m", "found"),
    [
        ((2.6, 3.0), 1, 0.0, True),  # far ahead of every other place in two joint looks: one pose confirms it
        ((2.6, 3.0), 0, 0.0, False),  # looks alone never do
        ((3.0, 2.0), 1, 0.0, False),  # the worse of the two counts
        ((9.0,), 1, 0.0, False),  # one look may be chance
        ((1.3, 1.3), 2, 20.0, True),
        ((1.3, 1.3), 2, 10.0, False),
        ((-1.0, -1.0), 2, 50.0, False),
        ((-1.0, -1.0), 3, 50.0, True),  # poses alone, over new ground
        ((-1.0, -1.0), 3, 30.0, False),
    ],
)
def test_the_further_a_place_leads_the_fewer_poses_it_needs(
    ground: np.ndarray, leads: tuple[float, ...], poses: int, span_m: float, found: bool
) -> None:
    tracks = searched(BoundedMap(ground), None).tracks
    tracks.all = [track_of(leads, poses, span_m)]
    assert tracks._is_found(tracks.all[0], predicted()) is found


def test_evidence_outweighs_the_number_of_places_and_every_rival(ground: np.ndarray) -> None:
    tracks = searched(BoundedMap(ground), None).tracks
    places = SIDE_M**2 / (0.4 * AGL_M) ** 2
    enough = float(np.log(places)) + ENOUGH
    few, plenty = (track_of((0.0, 0.0), 5, 90.0, score) for score in (enough - 0.1, enough + 0.1))
    rival = Track(200.0, 0.0, Hypothesis(0.0, 1.0), enough - 1.0, leads=(0.0, 0.0))
    tracks.all = [few]
    assert not tracks._is_found(few, predicted())
    tracks.all = [plenty]
    assert tracks._is_found(plenty, predicted())
    tracks.all = [plenty, rival]
    assert not tracks._is_found(plenty, predicted())


def test_a_lead_counts_once_it_has_lasted() -> None:
    track = track_of((), 0, 0.0, 0.0)
    assert track.lead == track.odds == 0.0
    track.looked_at(4.0)
    assert track.lead == 0.0
    track.looked_at(1.0)
    assert track.lead == 1.0 < track.odds
    track.looked_at(-2.0)
    assert track.lead == -2.0 and track.odds < 0.0 and len(track.leads) == LEADS


def test_what_is_needed_grows_as_the_lead_shrinks() -> None:
    leads, poses, spans = zip(*NEEDED, strict=True)
    assert sorted(leads, reverse=True) == list(leads)
    assert sorted(poses) == list(poses) and sorted(spans) == list(spans) and min(poses) >= 1


def test_more_patches_say_more() -> None:
    assert pose_gain(7) == 0.0 < pose_gain(8) < pose_gain(12) < pose_gain(20) == pose_gain(48)


# --- whether a place is still believed ----------------------------------------------------------------


def test_a_start_that_nothing_speaks_for_is_given_up_after_some_looks() -> None:
    watch = LostWatch()
    looks = 0
    while not watch.lost:
        watch.looked(0.6, 1.0, 1.0, 0, 10.0, AGL_M)
        looks += 1
    assert 12 <= looks <= 20


@pytest.mark.parametrize("weight", [0.1, 1.0])
def test_looks_at_the_right_place_keep_it(weight: float) -> None:
    """Without a single pose: what the frames say for the belief is enough."""
    watch = LostWatch()
    for _ in range(200):
        watch.looked(4.0 * weight, weight, weight, 0, 10.0, AGL_M)
        assert not watch.lost


def test_poses_carry_over_ground_without_texture_but_not_for_ever() -> None:
    watch = LostWatch()
    for _ in range(60):
        watch.looked(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    assert watch.odds == MOST_ODDS
    poor = 0
    while not watch.lost:
        watch.looked(-3.0, 1.0, 1.0, 0, 10.0, AGL_M)
        poor += 1
    assert 40 <= poor <= 60


def test_looks_at_one_field_say_nothing_against_it() -> None:
    watch = LostWatch()
    for _ in range(300):
        watch.looked(-0.2, 0.08, 0.0, 0, 10.0, AGL_M)
    assert not watch.lost and watch.doubt == 0.0


def test_doubt_is_a_probability_and_begins_when_the_ellipse_would_not_hold() -> None:
    watch = LostWatch()
    assert watch.doubt == 0.0
    said = []
    while not watch.lost:
        watch.looked(0.0, 0.5, 0.5, 0, 10.0, AGL_M)
        said.append(watch.doubt)
    first = next(doubt for doubt in said if doubt)
    assert said[0] == 0.0 and 0.05 <= first < 0.07 and said == sorted(said) and said[-1] > 0.5


def test_a_position_that_claims_little_is_not_given_up() -> None:
    watch = LostWatch()
    for _ in range(60):
        watch.looked(-3.0, 1.0, 1.0, 0, 80.0, AGL_M)
    assert not watch.lost


def test_a_way_that_nobody_saw_leaves_no_more_than_a_start() -> None:
    watch = LostWatch()
    for _ in range(60):
        watch.looked(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    watch.looked(0.0, 1.0, 1.0, 0, 80.0, AGL_M)
    assert watch.odds == LostWatch().odds
