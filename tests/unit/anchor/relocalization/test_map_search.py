"""Search over the whole map: found after several frames at the right place, not found elsewhere; lock monitor."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.hypothesis_tracker import (
    CLEAR_LEAD,
    CONFIRMATION_LLR,
    DECISION_MARGIN,
    LEAD_WINDOW,
    MIN_CONFIRMATIONS,
    NEIGHBOUR_RADIUS,
    NEW_EVIDENCE,
    TRACK_LLR_MAX,
    TRACK_LLR_MIN,
    AcceptedPlace,
    HypothesisTracker,
    PlaceHypothesis,
    _mahalanobis2,
    evidence,
)
from terrafix.anchor.verification.lock_monitor import MAX_LOG_ODDS, LockMonitor, pose_gain
from terrafix.anchor.verification.patch_consensus import PatchConsensus
from terrafix.anchor.verification.patch_null import COARSE_NULL, PRIOR_PLACES, REFERENCE_PATCHES, PatchNull
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget, NullRow
from terrafix.messages import SearchStep
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.retrieval.pooled import POOL
from textured_ground import PINHOLE, FlatMap, rotation, texture, view

AGL_M = 100.0
ENOUGH = 10.0  # evidence that a wrong place rarely reaches
SIDE_M = 500.0
STEP_M = np.array([9.0, 12.0])  # 15 m per frame
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
    """(image, camera position (3,)) along the path."""
    for i in range(count):
        p_m = np.array([*(START_M + i * STEP_M), AGL_M])
        yield view(ground, PINHOLE, rotation(HEADING_DEG), p_m), p_m


def searched(source: BoundedMap, around_m: tuple[float, float] | None, null: NullRow = DEFAULT_NULL) -> MapSearch:
    local: Any = source
    return MapSearch(
        local, FrameMatcher(PINHOLE, local, GradientDescriber()), AGL_M, around_m, null, FalseAlarmBudget()
    )


def predicted() -> View:
    """A view with an unknown position and a compass error."""
    wrong = rotation(HEADING_DEG + HEADING_ERROR_DEG)
    return View(9.0, 9.0, wrong, AGL_M, 0.0, float(np.radians(8.0)), 0.04, float(np.radians(2.0)))


def fly(search: MapSearch, ground: np.ndarray, count: int) -> tuple[AcceptedPlace | None, np.ndarray, int]:
    """-> the accepted place or None, the camera position in that frame, the number of frames."""
    p_m = np.zeros(3)
    for i, (image, p_m) in enumerate(frames(ground, count)):
        if i:
            search.predict(float(STEP_M[0]), float(STEP_M[1]), 1.0)
        found = search.process_frame(image, predicted())
        if found is not None:
            return found, p_m, i + 1
    return None, p_m, count


@pytest.mark.slow
def test_an_unknown_position_is_found(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    assert search.step is SearchStep.WHOLE_MAP
    found, p_m, after = fly(search, ground, 8)
    assert found is not None and found.fix.pnp.fit is not None
    assert np.linalg.norm(found.fix.pnp.fit.p_c_in_w_m - p_m) < 5.0
    assert np.hypot(found.track.e_m - p_m[0], found.track.n_m - p_m[1]) < 8.0
    assert np.degrees(found.track.hypothesis.yaw_rad) == pytest.approx(HEADING_ERROR_DEG, abs=3.0)
    assert MIN_CONFIRMATIONS <= after <= 4


def test_one_frame_is_not_enough_even_if_it_is_repeated(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    image, _ = next(frames(ground, 1))
    for _ in range(20):
        assert search.process_frame(image, predicted()) is None
        search.predict(0.0, 0.0, 4.0)  # hovering, with an uncertainty of 4 m
    assert search.tracker.tracks[0].frames == 1


@pytest.mark.slow
def test_a_null_model_with_higher_scores_requires_more_evidence(ground: np.ndarray) -> None:
    null = msgspec.structs.replace(DEFAULT_NULL, search=msgspec.structs.replace(DEFAULT_NULL.search, above=60.0))
    search = searched(BoundedMap(ground), None, null)
    found, _, after = fly(search, ground, 5)
    assert found is None and after == 5
    assert (
        search.tracker.tracks[0].log_odds > searched(BoundedMap(ground), None).required_evidence
    )  # enough with the default null model


def test_the_required_evidence_grows_per_stretch_of_new_ground_and_not_per_frame(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HypothesisTracker, "update", lambda *_: None)
    search, needed = searched(BoundedMap(ground), None), list[float]()
    image, _ = next(frames(ground, 1))
    for _ in range(11):
        search.process_frame(image, predicted())
        needed.append(search.required_evidence)
        search.predict(0.2 * NEW_EVIDENCE * AGL_M, 0.0, 1.0)
    assert needed[0] == needed[4] < needed[5] == needed[9] < needed[10]


def test_the_candidate_count_grows_with_map_and_yaws_and_falls_with_height(
    ground: np.ndarray,
) -> None:
    source, few, many = BoundedMap(ground), (Hypothesis(0.0, 1.0),), 3 * (Hypothesis(0.0, 1.0),)
    search = searched(source, None)
    search._hypotheses = few
    assert search.candidate_count == pytest.approx((SIDE_M / (NEIGHBOUR_RADIUS * AGL_M)) ** 2)
    search._hypotheses = many
    assert search.candidate_count == pytest.approx(3.0 * (SIDE_M / (NEIGHBOUR_RADIUS * AGL_M)) ** 2)
    search.agl_m = 10.0 * SIDE_M
    assert search.candidate_count == 3.0  # a map of one neighbourhood


def test_a_search_starts_with_the_patch_null_model_of_the_map(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None, msgspec.structs.replace(DEFAULT_NULL, patches=(1.5, 2.0)))
    assert search.tracker.null.patches == pytest.approx((1.5, 2.0))


def test_a_joint_correlation_is_wide_once_its_mosaic_is_long_enough(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HypothesisTracker, "update", lambda *_: None)
    search, wide = searched(BoundedMap(ground), None), list[bool]()
    for i, (image, _) in enumerate(frames(ground, 5)):
        if i:
            search.predict(float(STEP_M[0]), float(STEP_M[1]), 1.0)
        search.process_frame(image, predicted())
        wide.append(search.tracker.tracks[0].wide)
    assert wide == [False, False, False, False, True]  # 15 m per frame


@pytest.mark.slow
def test_ground_that_is_not_on_the_map_is_not_found() -> None:
    search = searched(BoundedMap(texture(21, SIDE_M)), None)
    assert fly(search, texture(8, SIDE_M), 2)[0] is None


def test_the_search_region_grows_to_the_whole_map_and_then_the_operator_is_asked(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(HypothesisTracker, "update", lambda *_: None)  # no track is accepted
    monkeypatch.setattr("terrafix.anchor.relocalization.map_search.FINE_HYPOTHESES", 0)  # pooled cells are faster
    monkeypatch.setattr("terrafix.anchor.relocalization.block_search.BLOCK_CELLS", 12)
    monkeypatch.setattr("terrafix.anchor.relocalization.map_search.BLOCK_CELLS", 12)
    search = searched(BoundedMap(ground), START_M.tolist())
    image, _ = next(frames(ground, 1))
    steps: list[tuple[SearchStep, int]] = []
    while search.step is not SearchStep.ASK:
        assert search.process_frame(image, predicted()) is None
        if (search.step, search.block_count) not in steps:
            steps.append((search.step, search.block_count))
        search.predict(0.0, 100.0, 1.0)
        assert len(steps) < 20
    blocks = [n for step, n in steps if step is SearchStep.WIDEN]
    assert blocks == [4, 9, 16, 25]  # the regions after the correlation of the first block
    assert [step for step, _ in steps[4:]] == [SearchStep.WHOLE_MAP, SearchStep.ASK]
    assert steps[-1][1] == steps[-2][1] > 25


def test_an_unknown_heading_or_a_large_map_uses_pooled_cells(ground: np.ndarray) -> None:
    def stride(side_m: float, yaw_sigma_deg: float) -> int:
        source = BoundedMap(ground)
        source.bounds_m = (-side_m / 2, -side_m / 2, side_m / 2, side_m / 2)
        search = searched(source, None)
        search._initialize(replace(predicted(), yaw_sigma_rad=float(np.radians(yaw_sigma_deg))))
        return search._correlator.stride

    assert stride(1000.0, 8.0) == 1
    assert stride(1000.0, 180.0) == stride(10_000.0, 8.0) == POOL


def test_a_step_with_a_large_sigma_drops_all_tracks(ground: np.ndarray) -> None:
    search = searched(BoundedMap(ground), None)
    search.tracker.propose(0.0, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    search.predict(20.0, 0.0, 0.3 * AGL_M)
    assert len(search.tracker.tracks) == 1
    search.predict(20.0, 0.0, 0.5 * AGL_M)
    assert not search.tracker.tracks


def test_odometry_moves_a_track() -> None:
    track = PlaceHypothesis(10.0, 20.0, Hypothesis(0.0, 1.0))
    track.predict(np.array([3.0, -4.0]))
    assert (track.e_m, track.n_m) == (13.0, 16.0)


def test_a_track_moves_by_its_own_yaw_and_scale() -> None:
    """Odometry gives steps under the predicted yaw and height; a track has its own."""
    track = PlaceHypothesis(10.0, 20.0, Hypothesis(np.pi / 2, 1.5))
    track.predict(np.array([4.0, 0.0]))  # east; a quarter turn counter-clockwise of that is north
    assert (track.e_m, track.n_m) == pytest.approx((10.0, 26.0))


def test_a_proposal_near_a_track_replaces_it_while_its_score_is_not_positive(ground: np.ndarray) -> None:
    tracks = searched(BoundedMap(ground), None).tracker
    for e_m in (0.0, 0.15 * AGL_M):
        tracks.propose(e_m, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert [t.e_m for t in tracks.tracks] == [0.15 * AGL_M]
    tracks.tracks[0].score = 1.0
    tracks.propose(0.0, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert [t.e_m for t in tracks.tracks] == [0.15 * AGL_M]
    tracks.propose(-0.1 * AGL_M, 0.0, Hypothesis(0.0, 1.0), AGL_M)
    assert len(tracks.tracks) == 2


def test_the_place_beside_the_best_one_becomes_a_track_too(ground: np.ndarray) -> None:
    """The best place of a joint correlation has a lower one beside it: both become tracks that lead other places."""
    search = searched(BoundedMap(ground), None)
    image, _ = next(frames(ground, 1))
    search.process_frame(image, predicted())
    search.tracker.tracks = []
    z = np.zeros(search._shape, np.float32)
    row, column = (side // 2 for side in search._shape)
    beside = round(0.3 * AGL_M / search._cell_m)
    z[row, column], z[row, column + beside], z[row + 3 * beside, column] = 9.0, 8.0, 5.0
    search._update_tracks(z, np.zeros(search._shape, np.uint8), AGL_M)
    best, second = sorted(search.tracker.tracks, key=lambda t: -t.leads[-1])[:2]
    assert second.e_m - best.e_m == pytest.approx(0.3 * AGL_M, abs=search._cell_m)
    assert best.leads[-1] == pytest.approx(9.0 - 5.0)
    assert second.leads[-1] == pytest.approx(8.0 - 5.0 - (9.0 - 8.0))


def track_of(
    score: float,
    leads: tuple[float, ...] = (),
    frames: int = MIN_CONFIRMATIONS,
    e_m: float = 0.0,
    *,
    wide: bool = False,
) -> PlaceHypothesis:
    return PlaceHypothesis(e_m, 0.0, Hypothesis(0.0, 1.0), score, frames, leads=leads, wide=wide)


@pytest.mark.parametrize(
    ("best", "rivals", "found"),
    [
        (track_of(ENOUGH + 0.1), [], True),
        (track_of(ENOUGH - 0.1), [], False),
        (track_of(ENOUGH + 0.1, frames=MIN_CONFIRMATIONS - 1), [], False),
        (
            track_of(ENOUGH + 0.1, leads=(2.0,), frames=MIN_CONFIRMATIONS - 1, wide=True),
            [],
            True,
        ),  # the wide joint correlation is the second confirmation
        # joint correlations alone are not enough
        (track_of(ENOUGH + 0.1, leads=(2.0,), frames=0, wide=True), [], False),
        (track_of(TRACK_LLR_MIN, leads=(5.0, 5.0), frames=0), [], False),
        (track_of(ENOUGH - 2.0, leads=(1.0, 1.0)), [], True),
        (track_of(ENOUGH - 2.0, leads=(9.0,)), [], False),  # a single lead may be random
        (track_of(ENOUGH - 2.0, leads=(9.0, -1.0)), [], False),
        (track_of(ENOUGH + 4.0), [track_of(ENOUGH, e_m=200.0)], False),  # repetitive ground
        (track_of(ENOUGH + DECISION_MARGIN + 0.1), [track_of(ENOUGH, e_m=200.0)], True),
    ],
)
def test_an_accepted_track_has_the_required_evidence_and_the_decision_margin(
    ground: np.ndarray, best: PlaceHypothesis, rivals: list[PlaceHypothesis], found: bool
) -> None:
    tracks = searched(BoundedMap(ground), None).tracker
    tracks.tracks = [best, *rivals]
    assert tracks._is_accepted(best, ENOUGH) is found


def test_the_same_ground_counts_once() -> None:
    """Independent of the number of frames; evidence against a place also counts once."""
    track = PlaceHypothesis(0.0, 0.0, Hypothesis(0.0, 1.0))
    for i in range(11):
        track.update_score(TRACK_LLR_MAX, i * 0.1 * NEW_EVIDENCE * AGL_M, AGL_M)
    assert track.score == pytest.approx(2.0 * TRACK_LLR_MAX) and track.frames == 11
    for i in range(30):
        track.update_score(TRACK_LLR_MIN, (1 + i) * NEW_EVIDENCE * AGL_M, AGL_M)
    assert track.score == TRACK_LLR_MIN


def test_a_frame_with_little_evidence_is_no_confirmation() -> None:
    track = PlaceHypothesis(0.0, 0.0, Hypothesis(0.0, 1.0))
    track.update_score(CONFIRMATION_LLR - 0.1, 0.0, AGL_M)
    assert track.score > 0.0 and track.frames == 0
    track.update_score(CONFIRMATION_LLR + 0.1, AGL_M, AGL_M)
    assert track.frames == 1


def test_a_lead_counts_once_it_persists() -> None:
    track = track_of(0.0)
    assert track.lead == track.log_odds == 0.0
    track.add_lead(4.0, wide=False)
    assert track.lead == 0.0
    track.add_lead(1.0, wide=False)
    assert track.lead == 1.0 < track.log_odds
    track.add_lead(-2.0, wide=False)
    assert track.lead == -2.0 and track.log_odds < 0.0 and len(track.leads) == LEAD_WINDOW


def test_a_lead_in_a_wide_joint_correlation_counts_at_once_and_as_a_confirmation() -> None:
    track = track_of(ENOUGH)
    track.frames = 1
    track.add_lead(CLEAR_LEAD, wide=False)
    track.add_lead(CLEAR_LEAD, wide=False)
    assert (track.lead, track.total_confirmations) == (CLEAR_LEAD, 1)
    track.add_lead(2.0, wide=True)
    assert (track.lead, track.total_confirmations) == (2.0, 2)
    track.add_lead(CLEAR_LEAD - 0.1, wide=True)
    assert track.total_confirmations == 1


def test_yaw_and_scale_near_the_prediction_raise_the_log_odds_and_others_lower_them() -> None:
    track, view = track_of(0.0), replace(predicted(), yaw_sigma_rad=0.1, scale_sigma=0.1)
    assert track.log_odds == 0.0  # without an observation
    for hypothesis, expected in (
        (Hypothesis(0.0, 1.0), True),
        (Hypothesis(0.35, 1.0), False),
        (Hypothesis(0.0, 0.7), False),
    ):
        track.mahalanobis2 = _mahalanobis2(hypothesis, view)
        assert (track.log_odds > 0.0) is expected
    known = replace(view, yaw_sigma_rad=0.0, scale_sigma=0.0)
    assert 1.0 < _mahalanobis2(Hypothesis(0.1, 1.0), known) < 2.0  # one frame's patches leave an error of some degrees


def of(llr: float, patches: int = REFERENCE_PATCHES) -> PatchConsensus:
    return PatchConsensus(llr, np.zeros(6), np.zeros((patches, 2)), np.zeros(patches, bool), np.zeros((2, 2)))


def test_a_consensus_at_the_level_of_the_null_model_is_no_evidence() -> None:
    null, by_chance = PatchNull(), COARSE_NULL[0]

    def gain(llr: float, patches: int) -> float:
        return evidence(null.sigmas(of(llr, patches), fine=False))

    assert gain(by_chance, REFERENCE_PATCHES) == TRACK_LLR_MIN < 0.0 < gain(2.0 * by_chance, REFERENCE_PATCHES)
    assert gain(40.0, REFERENCE_PATCHES) == TRACK_LLR_MAX
    assert gain(0.25 * by_chance, REFERENCE_PATCHES // 4) < 0.0  # with fewer patches the null model is lower
    assert gain(by_chance, REFERENCE_PATCHES // 4) > gain(by_chance, REFERENCE_PATCHES)


def test_repetitive_ground_raises_the_null_model() -> None:
    """Its wrong places raise the null model, on coarse and on fine cells."""
    null = PatchNull()
    before = null.sigmas(of(16.0), fine=True)
    for llr in np.random.default_rng(1).normal(12.0, 2.7, 200):
        null.add(of(float(llr)), fine=True)
        null.add(of(60.0, REFERENCE_PATCHES // 2), fine=True)  # half of the patches off the map
    assert before > 2.5 and null.sigmas(of(16.0), fine=True) == pytest.approx(1.55, abs=0.3)
    assert null.sigmas(of(16.0), fine=False) < PatchNull().sigmas(of(16.0), fine=False) - 1.0


def test_without_other_active_tracks_the_null_model_is_estimated_from_inactive_ones(ground: np.ndarray) -> None:
    tracks, (image, p_m) = searched(BoundedMap(ground), None).tracker, next(frames(ground, 1))
    for k, e_m in enumerate((0.0, -0.5, 0.5, -1.0)):
        tracks.propose(float(p_m[0]) + e_m * AGL_M, float(p_m[1]), Hypothesis(0.0, 1.0), AGL_M)
        tracks.tracks[-1].add_lead(-9.0 if k else 2.0, wide=False)
    tracks.update(image, predicted(), 0.0, ENOUGH)
    assert len(tracks.tracks) == 1 and tracks.null._sums[0] == PRIOR_PLACES + 3.0
    assert not tracks.null.is_estimated


def test_more_patches_give_more_evidence() -> None:
    assert pose_gain(7) == 0.0 < pose_gain(8) < pose_gain(12) < pose_gain(20) == pose_gain(48)


# --- lock monitor ---------------------------------------------------------------------------------


def test_a_start_without_evidence_is_lost_after_some_observations() -> None:
    monitor = LockMonitor()
    observations = 0
    while not monitor.lost:
        monitor.update(0.6, 1.0, 1.0, 0, 10.0, AGL_M)
        observations += 1
    assert 12 <= observations <= 20


@pytest.mark.parametrize(
    ("count", "observation"),
    [
        pytest.param(200, (4.0, 1.0, 1.0, 0, 10.0), id="at the right place without a pose"),
        pytest.param(200, (0.4, 0.1, 0.1, 0, 10.0), id="at the right place with a low weight"),
        pytest.param(300, (-0.2, 0.08, 0.0, 0, 10.0), id="of one field again and again"),
        pytest.param(60, (-3.0, 1.0, 1.0, 0, 80.0), id="against a position with a large sigma"),
    ],
)
def test_these_observations_keep_the_lock(count: int, observation: tuple[float, float, float, int, float]) -> None:
    """``observation``: evidence, weight, share of new ground, inliers of the pose, sigma."""
    monitor = LockMonitor()
    for _ in range(count):
        monitor.update(*observation, AGL_M)
        assert not monitor.lost
    assert monitor.wrong_probability == 0.0


def test_poses_keep_the_lock_over_ground_without_texture_for_a_limited_time() -> None:
    monitor = LockMonitor()
    for _ in range(60):
        monitor.update(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    assert monitor.log_odds == MAX_LOG_ODDS
    poor = 0
    while not monitor.lost:
        monitor.update(-3.0, 1.0, 1.0, 0, 10.0, AGL_M)
        poor += 1
    assert 40 <= poor <= 60


def test_the_wrong_probability_is_reported_from_five_per_cent_on() -> None:
    monitor = LockMonitor()
    assert monitor.wrong_probability == 0.0
    probabilities = []
    while not monitor.lost:
        monitor.update(0.0, 0.5, 0.5, 0, 10.0, AGL_M)
        probabilities.append(monitor.wrong_probability)
    first = next(doubt for doubt in probabilities if doubt)
    assert (
        probabilities[0] == 0.0
        and 0.05 <= first < 0.07
        and probabilities == sorted(probabilities)
        and probabilities[-1] > 0.5
    )


def test_after_an_unobserved_path_the_log_odds_are_at_most_those_of_a_start() -> None:
    monitor = LockMonitor()
    for _ in range(60):
        monitor.update(7.0, 1.0, 1.0, 20, 10.0, AGL_M)
    monitor.update(0.0, 1.0, 1.0, 0, 80.0, AGL_M)
    assert monitor.log_odds == LockMonitor().log_odds
