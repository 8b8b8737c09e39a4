"""Steps of the search escalation by the fragments of odometry."""

import pytest

from terrafix.anchor.fragment_labels import FragmentLabels
from terrafix.messages import MapMatch, MapPose, Prediction, SearchResult, SearchStep, Verdict

NEW, MERGE, SKIP = SearchStep.NEW_FRAGMENT, SearchStep.MERGE, SearchStep.SKIP


def prediction(fragment_id: int, *, joined: bool = True) -> Prediction:
    return Prediction(
        t_ns=0,
        frame_id=0,
        p_c_in_w_m=(0.0, 0.0, 100.0),
        q_w_c=(1.0, 0.0, 0.0, 0.0),
        cov=(0.0,) * 36,
        agl_m=100.0,
        agl_sigma_m=1.0,
        step_m=(0.0, 0.0),
        step_cov_m2=(900.0, 0.0, 0.0, 900.0),
        fragment_id=fragment_id,
        joined=joined,
    )


def match(
    verdict: Verdict = Verdict.AMBIGUOUS, *, coarse: bool = False, step: SearchStep = SearchStep.NORMAL
) -> MapMatch:
    pose = MapPose(p_c_in_w_m=(0.0, 0.0, 100.0), q_w_c=(1.0, 0.0, 0.0, 0.0), cov=(0.0,) * 36, position_only=coarse)
    accepted = verdict is Verdict.ACCEPTED
    search = SearchResult(step=step)
    return MapMatch(
        t_ns=0, frame_id=0, verdict=verdict, matcher="gradient", pose=pose if accepted else None, search=search
    )


def steps(labels: FragmentLabels, *frames: tuple[MapMatch, Prediction]) -> list[SearchStep | None]:
    return [labels.step_of(*frame) for frame in frames]


@pytest.mark.parametrize(
    ("fragments", "expected"),
    [
        pytest.param(
            [(0, True), (0, True), (1, False), (1, False), (2, False), (3, False)],
            [None, None, NEW, None, NEW, NEW],
            id="the first fragment of a flight is no step and each later one is",
        ),
        pytest.param([(0, True)] * 3, [None] * 3, id="a step with 30 m 1-sigma is no new fragment"),
        pytest.param(
            [(0, False), (1, False), (0, False), (-1, False), (1, False)],
            [None, NEW, None, SKIP, None],
            id="a fragment that continues an older one is not new",
        ),
        pytest.param(
            [(0, True), (1, False), (1, True), (1, True)],
            [None, NEW, MERGE, None],
            id="a fragment that the estimator has joined is merged without a map",
        ),
        pytest.param(
            [(0, True), (1, False), (-1, True)],
            [None, NEW, SKIP],
            id="a frame of no fragment merges none and is skipped",
        ),
    ],
)
def test_fragments_without_a_pose_on_the_map_have_these_steps(
    fragments: list[tuple[int, bool]], expected: list[SearchStep | None]
) -> None:
    flown = [(match(), prediction(i, joined=joined)) for i, joined in fragments]
    assert steps(FragmentLabels(), *flown) == expected


def test_the_first_frame_of_a_fragment_that_is_not_skipped_has_the_step() -> None:
    skipped = match(step=SearchStep.SKIP)
    flown = [(match(), prediction(0)), (skipped, prediction(1, joined=False)), (match(), prediction(1, joined=False))]
    assert steps(FragmentLabels(), *flown) == [None, None, NEW]


@pytest.mark.parametrize(("coarse", "step"), [(False, MERGE), (True, None)])
def test_a_pose_on_the_map_merges_a_new_fragment_once_and_a_coarse_match_does_not(
    coarse: bool, step: SearchStep | None
) -> None:
    fixed = match(Verdict.ACCEPTED, coarse=coarse)
    open_fragment = prediction(1, joined=False)
    flown = [(match(), prediction(0)), (match(), open_fragment), (fixed, open_fragment), (fixed, open_fragment)]
    assert steps(FragmentLabels(), *flown) == [None, NEW, step, None]


@pytest.mark.parametrize("by_map", [match(Verdict.ACCEPTED), match(Verdict.LOST, step=SearchStep.WIDEN)])
def test_a_frame_of_no_fragment_that_the_map_places_or_a_search_uses_is_not_skipped(by_map: MapMatch) -> None:
    assert steps(FragmentLabels(), (match(), prediction(0)), (by_map, prediction(-1))) == [None, None]


def test_a_place_that_a_search_has_found_is_a_merge() -> None:
    found = MapMatch(t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="", search=SearchResult(relocalized=True))
    assert steps(FragmentLabels(), (match(), prediction(0)), (found, prediction(0))) == [None, MERGE]
