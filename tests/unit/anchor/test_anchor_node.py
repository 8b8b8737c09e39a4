"""Anchor node: tracking, search, search steps and layer selection."""

from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from anchor_rig import started
from map_matches import position_of
from single_map_place import AGL_M, ORIGIN, SIDE_M, TRUE_M, R, SingleMapPackage, predicted
from terrafix.anchor.matching.frame_matcher import AS_PREDICTED, CorrelationResult, FrameMatcher
from terrafix.anchor.matching.match_message import ground_sigma_m
from terrafix.anchor.matching.point_mass_filter import Belief
from terrafix.anchor.node import AnchorNode
from terrafix.anchor.relocalization.map_search import MapSearch, ProposedPlace
from terrafix.anchor.relocalization.relocalizer import LOST_SIGMA_M, search_centre
from terrafix.anchor.verification.consensus_pose import ConsensusPose
from terrafix.anchor.verification.lock_monitor import LockMonitor
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.pose import PoseFit, world_to_tangent
from terrafix.map.null_model import DEFAULT_NULL, SCORE_VERSION, NullModel
from terrafix.messages import (
    Health,
    MapMatch,
    Message,
    Prediction,
    SearchPlaces,
    SearchState,
    SearchStep,
    ThermalBand,
    Verdict,
)
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, texture, view

CELL_M = 2.0  # of a belief


def match(node: AnchorNode, frame_id: int, sigma_m: float, at_m: np.ndarray = TRUE_M, step_m: float = 0.0) -> MapMatch:
    answer, *_ = node.on(predicted(frame_id, sigma_m, at_m=at_m, step_m=step_m))
    assert isinstance(answer, MapMatch)
    return answer


def health(band: ThermalBand) -> Health:
    return Health(t_ns=0, band=band, temperature_c=90.0, throttled=False, disk_free_mb=None, cause="test")


def test_a_right_position_is_tracked_with_accepted_poses(ground: np.ndarray) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 1, 10.0)
    assert result.verdict is Verdict.ACCEPTED and not result.position_only and not result.search.relocalized
    assert (result.search.step, result.search.sigma_m) == (SearchStep.NORMAL, 0.0)


@pytest.mark.parametrize(("band", "every"), [(ThermalBand.NORMAL, 1), (ThermalBand.HOT, 2), (ThermalBand.CRITICAL, 4)])
def test_a_hot_computer_matches_one_frame_of_several(ground: np.ndarray, band: ThermalBand, every: int) -> None:
    node, frames = started(ground)
    assert list(node.on(health(band))) == []
    verdicts = []
    for i in range(1, 9):
        frames.put(i, view(ground, PINHOLE, R, TRUE_M))
        result = match(node, i, 10.0)
        verdicts.append(result.verdict)
        assert (result.matches == []) is (result.verdict is Verdict.THROTTLED)
    assert verdicts == [Verdict.ACCEPTED if i % every == 0 else Verdict.THROTTLED for i in range(1, 9)]
    list(node.on(health(ThermalBand.NORMAL)))
    frames.put(9, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 9, 10.0).verdict is Verdict.ACCEPTED


def test_the_belief_moves_by_odometry_while_frames_are_skipped(ground: np.ndarray) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 1, 10.0).verdict is Verdict.ACCEPTED
    list(node.on(health(ThermalBand.CRITICAL)))
    for i in range(2, 6):
        at_m = TRUE_M + np.array([6.0 * (i - 1), 0.0, 0.0])
        frames.put(i, view(ground, PINHOLE, R, at_m))
        result = match(node, i, 10.0, at_m=at_m, step_m=6.0)
    assert result.verdict is Verdict.ACCEPTED
    assert np.linalg.norm(np.array(position_of(result)) - at_m) < 3.0


@pytest.fixture
def correlated_scales(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Number of scales of the height that each correlation tries, in order."""
    counts, correlate = list[int](), FrameMatcher.correlate

    def counted(*of: Any) -> CorrelationResult:
        result = correlate(*of)
        counts.append(len({h.scale for h in result.hypotheses}))
        return result

    monkeypatch.setattr(FrameMatcher, "correlate", counted)
    return counts


def at_uncertain_height(frame_id: int, at_m: np.ndarray = TRUE_M, step_m: float = 0.0) -> Prediction:
    """A prediction whose height is known to 5 %, so that three scales fit it."""
    return msgspec.structs.replace(predicted(frame_id, 10.0, at_m=at_m, step_m=step_m), agl_sigma_m=0.05 * AGL_M)


def test_one_scale_is_correlated_after_a_match_at_the_predicted_scale_and_three_after_a_gap_or_a_miss(
    ground: np.ndarray, correlated_scales: list[int]
) -> None:
    node, frames = started(ground)
    steps_m = [0.0, 3.0, 3.0, 0.4 * AGL_M, 3.0]
    for i, (east_m, step_m) in enumerate(zip(np.cumsum(steps_m), steps_m, strict=True)):
        here_m = TRUE_M + np.array([east_m, 0.0, 0.0])
        frames.put(i, view(ground, PINHOLE, R, here_m))
        answer, *_ = node.on(at_uncertain_height(i, here_m, step_m))
        assert isinstance(answer, MapMatch) and answer.verdict is Verdict.ACCEPTED
    assert correlated_scales == [3, 1, 1, 3, 1]
    frames.put(5, np.full_like(view(ground, PINHOLE, R, TRUE_M), 90))  # no texture: a miss
    frames.put(6, view(ground, PINHOLE, R, here_m))
    for i in (5, 6):
        list(node.on(at_uncertain_height(i, here_m)))
    assert correlated_scales[5:] == [1, 3]


def test_three_scales_are_correlated_after_a_match_at_another_scale(
    ground: np.ndarray, correlated_scales: list[int]
) -> None:
    node, frames = started(ground)
    higher_m = TRUE_M * np.array([1.0, 1.0, 1.08])
    for i in range(2):
        frames.put(i, view(ground, PINHOLE, R, higher_m))
        answer, *_ = node.on(at_uncertain_height(i))
        assert isinstance(answer, MapMatch) and answer.verdict is Verdict.ACCEPTED
    assert correlated_scales == [3, 3]


def test_a_search_of_a_hot_computer_stays_lost_in_the_frames_that_it_skips(ground: np.ndarray) -> None:
    node, frames = started(ground, start_sigma_m=5000.0)
    list(node.on(health(ThermalBand.HOT)))
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 1, 100.0)
    assert (result.verdict, result.search.sigma_m) == (Verdict.LOST, LOST_SIGMA_M)


def test_without_a_single_patch_pose_the_patch_consensus_gives_the_pose(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The consensus pose does not count as a confirmation, because that would keep a wrong position for long."""
    calls = list[int]()
    monkeypatch.setattr(FrameMatcher, "fix", lambda *_: None)
    monkeypatch.setattr(LockMonitor, "update", lambda _self, _gain, _weight, _new, inliers, *_: calls.append(inliers))
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 1, 10.0)
    assert result.verdict is Verdict.ACCEPTED and not result.position_only and result.pose is not None
    assert np.linalg.norm(np.array(position_of(result)) - TRUE_M) < 3.0
    assert calls == [0]
    # without the consensus, the mode's position remains
    monkeypatch.setattr(ConsensusPose, "estimate", lambda *_: None)
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 2, 10.0).position_only


@pytest.mark.parametrize(("sigma_m", "expected"), [(0.019 * AGL_M, False), (0.021 * AGL_M, True)])
def test_a_single_patch_pose_with_a_large_sigma_is_replaced_by_the_patch_consensus(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch, sigma_m: float, expected: bool
) -> None:
    calls, estimate = list[bool](), ConsensusPose.estimate
    monkeypatch.setattr("terrafix.anchor.frame_pose.ground_sigma_m", lambda *_: sigma_m)
    monkeypatch.setattr(ConsensusPose, "estimate", lambda *of: calls.append(True) or estimate(*of))
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 1, 10.0)
    assert result.verdict is Verdict.ACCEPTED and not result.position_only
    assert np.linalg.norm(np.array(position_of(result)) - TRUE_M) < 3.0
    assert bool(calls) is expected
    monkeypatch.setattr(ConsensusPose, "estimate", lambda *_: None)  # without a consensus the first pose is used
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    assert not match(node, 2, 10.0).position_only


def test_correlated_tilt_and_position_errors_do_not_move_the_observed_ground() -> None:
    jacobian = np.zeros((6, 1))
    jacobian[0], jacobian[4] = AGL_M, 1.0  # east, with the rotation about north that moves the ground back
    cov = np.diag([4.0, 1.0, 9.0, 1e-12, 1e-12, 1e-4]) + jacobian @ jacobian.T * np.radians(10.0) ** 2
    fit = PoseFit(np.eye(3), np.array([0.0, 0.0, AGL_M]), world_to_tangent(cov, np.eye(3)), np.zeros(0), 0.0)
    assert ground_sigma_m(fit, AGL_M) == pytest.approx(2.0, abs=1e-3)


def test_a_missing_frame_gives_bad_image_and_step_skip(ground: np.ndarray) -> None:
    node, _ = started(ground)
    result = match(node, 1, 10.0)
    assert (result.verdict, result.search.step) == (Verdict.BAD_IMAGE, SearchStep.SKIP)


def test_an_unknown_start_is_searched_on_the_whole_map(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 1, 100.0)
    assert (result.verdict, result.search.step, result.search.sigma_m) == (
        Verdict.LOST,
        SearchStep.WHOLE_MAP,
        LOST_SIGMA_M,
    )
    assert result.pose is None and not result.search.relocalized


def test_the_required_evidence_follows_the_null_model_of_the_map_at_this_height(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed = list[float]()
    monkeypatch.setattr(MapSearch, "process_frame", lambda search, *_: needed.append(search.required_evidence))
    rows = tuple(
        msgspec.structs.replace(
            DEFAULT_NULL, agl_m=agl_m, search=msgspec.structs.replace(DEFAULT_NULL.search, above=above)
        )
        for agl_m, above in ((0.5 * AGL_M, 1e3), (1.1 * AGL_M, 50.0))
    )
    layer = SimpleNamespace(
        table="imagery",
        ce90_m=None,
        ce90_origin=None,
        null_model=NullModel(version=SCORE_VERSION, matcher="gradient", rows=rows),
        is_drawn=False,
    )
    for manifest in (SingleMapPackage.manifest, SimpleNamespace(layers=(layer,))):
        monkeypatch.setattr(SingleMapPackage, "manifest", manifest)
        node, frames = started(ground, 5000.0)
        frames.put(1, view(ground, PINHOLE, R, TRUE_M))
        match(node, 1, 100.0)
    assert needed[0] < 20.0
    assert needed[1] == pytest.approx(needed[0] + 50.0 - DEFAULT_NULL.search.above)


def test_a_search_moves_by_the_step_covariance_and_not_by_the_growth_of_the_position_covariance(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A heading 1-sigma of ten degrees adds metres of position error per frame; the search has its own yaw
    hypotheses."""
    steps_m = list[float]()
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    monkeypatch.setattr(MapSearch, "predict", lambda _self, _east, _north, sigma_m: steps_m.append(sigma_m))
    node, frames = started(ground, 5000.0)
    for i, sigma_m in enumerate((100.0, 100.5, 101.0)):
        frames.put(i, view(ground, PINHOLE, R, TRUE_M))
        list(node.on(predicted(i, sigma_m, step_sigma_m=1.0, step_m=10.0)))
    assert steps_m == [1.0, 1.0]


def test_an_anchor_restarted_in_flight_does_not_search_a_position_that_is_known(ground: np.ndarray) -> None:
    node, frames = started(ground, 5000.0)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    assert match(node, 1, 10.0).verdict is Verdict.ACCEPTED


def test_a_search_is_centred_on_a_prior_unless_the_prior_is_as_wide_as_the_map(ground: np.ndarray) -> None:
    source: Any = SingleMapPackage(ground)
    source.bounds_m = (-4000.0, -1000.0, 4000.0, 1000.0)
    assert search_centre(30.0, 40.0, 1500.0, source) == (30.0, 40.0)
    assert search_centre(30.0, 40.0, 2500.0, source) is None


def test_a_lost_position_is_withdrawn_and_reported(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    node, frames = started(ground)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    monkeypatch.setattr(LockMonitor, "lost", True)
    result = match(node, 1, 10.0)
    assert (result.verdict, result.search.step, result.search.sigma_m) == (Verdict.LOST, SearchStep.WIDEN, LOST_SIGMA_M)
    assert result.matches == [] and result.pose is None
    assert match(node, 2, 10.0).verdict is Verdict.LOST  # also without a frame


def test_every_change_of_the_search_step_is_published(ground: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> None:
    node, frames = started(ground)
    image_of_place = view(ground, PINHOLE, R, TRUE_M)
    states: list[SearchState] = []

    def fly(frame_id: int, image: np.ndarray | None, fragment_id: int = 0) -> None:
        if image is not None:
            frames.put(frame_id, image)
        prediction = msgspec.structs.replace(predicted(frame_id, 10.0), fragment_id=fragment_id, joined=not fragment_id)
        states.extend(m for m in node.on(prediction) if isinstance(m, SearchState))

    fly(1, image_of_place)
    fly(2, None)
    fly(3, image_of_place)
    fly(4, image_of_place, fragment_id=1)
    fly(5, image_of_place, fragment_id=1)
    fly(6, image_of_place, fragment_id=1)
    assert [(m.step, m.fragment_id, m.joined) for m in states] == [
        (SearchStep.SKIP, 0, True),
        (SearchStep.NORMAL, 0, True),
        (SearchStep.NEW_FRAGMENT, 1, False),
        (SearchStep.MERGE, 1, True),
        (SearchStep.NORMAL, 1, False),
    ]
    states.clear()
    with monkeypatch.context() as patched:
        patched.setattr(LockMonitor, "lost", True)
        patched.setattr(MapSearch, "process_frame", lambda *_: None)
        fly(7, image_of_place)
        patched.setattr(MapSearch, "step", SearchStep.ASK)
        fly(8, image_of_place)
    assert [m.step for m in states] == [SearchStep.WIDEN, SearchStep.ASK]


@pytest.mark.parametrize(("heading_sigma_rad", "spreads"), [(0.03, False), (3.0, True)])
def test_without_a_heading_the_belief_spreads_by_the_length_of_the_step(
    ground: np.ndarray, heading_sigma_rad: float, spreads: bool
) -> None:
    node, _ = started(ground)
    for frame_id, step_m in ((1, 0.0), (2, 30.0)):
        result = predicted(frame_id, 10.0, step_m=step_m)
        list(node.on(msgspec.structs.replace(result, cov=(*result.cov[:35], heading_sigma_rad**2))))
    belief = node._localizer._belief
    assert belief is not None and (np.sqrt(belief.covariance()[2]) > 25.0) == spreads


@pytest.mark.slow
@pytest.mark.parametrize(("heading_sigma_rad", "tried"), [(0.03, False), (3.0, True)])
def test_without_a_heading_a_pose_is_attempted_in_a_light_mode(
    ground: np.ndarray, heading_sigma_rad: float, tried: bool
) -> None:
    node, frames = started(ground)
    result = predicted(1, 10.0)
    result = msgspec.structs.replace(result, cov=(*result.cov[:35], heading_sigma_rad**2))
    list(node.on(result))  # initializes the belief
    node._localizer._belief = Belief(float(TRUE_M[0]), float(TRUE_M[1]), 80.0, CELL_M)
    node._localizer._since_observation_m = 0.0  # ground that was just observed has little weight
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    answer, *_ = node.on(msgspec.structs.replace(result, frame_id=2))
    assert isinstance(answer, MapMatch) and answer.verdict is Verdict.AMBIGUOUS
    assert (answer.inliers > 0) == tried


def test_a_new_origin_resets_the_localizer(ground: np.ndarray) -> None:
    node, frames = started(ground)
    fresh = vars(started(ground)[0]._localizer)
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    match(node, 1, 10.0)
    node._localizer._poor_weight = 3.0
    list(node.on(msgspec.structs.replace(ORIGIN, t_ns=1)))
    for name in ("_belief", "_since_observation_m", "_poor_weight", "_variance_m2", "_labels"):
        assert vars(node._localizer)[name] == fresh[name], name


class TwoLayers:
    """The newest layer shows other ground, as after construction; the older one is right and states its accuracy."""

    manifest = SimpleNamespace(
        layers=tuple(
            SimpleNamespace(table=table, ce90_m=ce90_m, ce90_origin=None, null_model=None, is_drawn=False)
            for table, ce90_m in (("new", None), ("old", 5.0))
        )
    )

    def __init__(self, ground: np.ndarray) -> None:
        self._maps = {"new": SingleMapPackage(texture(77, SIDE_M)), "old": SingleMapPackage(ground)}

    def bind(self, _frame: object, layer: str) -> SingleMapPackage:
        return self._maps[layer]


@pytest.mark.slow
def test_the_layer_that_fits_is_selected_in_flight(ground: np.ndarray) -> None:
    package: Any = TwoLayers(ground)
    frames = MemoryFrameStore(8)
    node = AnchorNode(frames, package, GradientDescriber(), 10.0)
    list(node.on(ORIGIN))
    result = []
    for frame_id in range(1, 9):
        at_m = TRUE_M + np.array([15.0 * (frame_id - 4), 0.0, 0.0])
        frames.put(frame_id, view(ground, PINHOLE, R, at_m))
        result.append(match(node, frame_id, 10.0, at_m, step_m=15.0 if frame_id > 1 else 0.0))
    assert result[0].verdict is not Verdict.ACCEPTED and result[0].map_sigma_m == pytest.approx(10.0 / 2.146)
    assert [m.verdict for m in result[-2:]] == [Verdict.ACCEPTED] * 2
    assert result[-1].map_sigma_m == pytest.approx(5.0 / 2.146)
    assert np.hypot(*(np.array(position_of(result[-1])) - at_m)[:2]) < 3.0


@pytest.mark.parametrize(
    ("off_m", "sigma_m", "searches"), [(4000.0, 1400.0, True), (4000.0, 1300.0, False), (50.0, 30.0, False)]
)
def test_a_position_off_the_map_starts_a_search_if_its_sigma_reaches_the_map(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch, off_m: float, sigma_m: float, searches: bool
) -> None:
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    node, frames = started(ground)
    assert node._localizer._layers is not None
    e_max = node._localizer._layers.best.map.bounds_m[2]
    frames.put(1, view(ground, PINHOLE, R, TRUE_M))
    match(node, 1, 10.0)
    away = np.array([e_max + off_m, TRUE_M[1], TRUE_M[2]])
    frames.put(2, view(ground, PINHOLE, R, TRUE_M))
    result = match(node, 2, sigma_m, at_m=away, step_m=float(away[0] - TRUE_M[0]))
    assert (result.verdict is Verdict.LOST) == searches
    assert node._localizer._relocalizer.is_active == searches


def test_the_places_of_a_search_are_published_with_each_joint_correlation(
    ground: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, frames = started(ground)
    published: list[list[Message]] = []
    monkeypatch.setattr(LockMonitor, "lost", True)
    monkeypatch.setattr(MapSearch, "process_frame", lambda *_: None)
    for frame_id in range(1, 6):
        frames.put(frame_id, view(ground, PINHOLE, R, TRUE_M))
        if frame_id == 2:  # a joint correlation
            monkeypatch.setattr(MapSearch, "cell_m", 0.5)
            monkeypatch.setattr(MapSearch, "tiles", 4)
            search = node._localizer.search
            assert search is not None
            search.proposed = [ProposedPlace(10.0 * k, -float(k), AS_PREDICTED) for k in range(7)]
        if frame_id == 4:
            monkeypatch.setattr(MapSearch, "tiles", None)
        published.append(list(node.on(predicted(frame_id, 10.0))))
    assert [[type(m) for m in messages if isinstance(m, (SearchPlaces, MapMatch))] for messages in published] == [
        [MapMatch],
        [MapMatch, SearchPlaces],
        [MapMatch],
        [MapMatch, SearchPlaces],
        [MapMatch],
    ]
    first, second = (m for messages in published for m in messages if isinstance(m, SearchPlaces))
    assert (first.frame_id, first.tiles) == (2, 4)
    frame = LocalFrame(ORIGIN.lat_deg, ORIGIN.lon_deg)
    places_m = [frame.to_local(*place) for place in first.places]
    assert np.allclose(places_m, [(0.0, 0.0), (10.0, -1.0), (20.0, -2.0), (30.0, -3.0), (40.0, -4.0)], atol=1e-3)
    camera = ORIGIN.camera
    assert first.half_size_m == pytest.approx(AGL_M * np.hypot(camera.width, camera.height) / camera.fx / 2)
    assert (second.frame_id, second.tiles, second.places) == (4, None, first.places)
