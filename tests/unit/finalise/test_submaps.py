"""When frames that agree with each other are taken for this flight."""

import math

import numpy as np
import pytest

from terrafix.estimator.integrity.fragments import (
    AGREES_D2,
    FOREIGN_SPEED_MPS,
    JOIN_FRAMES,
    JOIN_LLR,
    Fragment,
    Fragments,
    MapHits,
    MotionEvidence,
)


def evidence(off_m: float, sigma_m: float = 0.5, over_s: float = 0.5) -> MotionEvidence:
    return MotionEvidence(np.array([off_m, 0.0]), sigma_m**2 * np.eye(2), over_s)


def test_the_evidence_of_a_motion_is_the_ratio_of_the_two_densities() -> None:
    own = math.exp(-0.5 * (0.7 / 0.5) ** 2) / (2.0 * math.pi * 0.5**2)
    foreign = 1.0 / (math.pi * (FOREIGN_SPEED_MPS * 0.5) ** 2)
    assert evidence(0.7).llr == pytest.approx(math.log(own / foreign))


def test_motion_speaks_for_the_flight_when_it_is_twenty_times_as_likely_as_that_of_any_up_to_30_mps() -> None:
    sigma_m, foreign = 0.5, 1.0 / (math.pi * (30.0 * 0.5) ** 2)
    for factor, speaks in ((18.0, False), (22.0, True)):
        off_m = sigma_m * math.sqrt(-2.0 * math.log(factor * foreign * 2.0 * math.pi * sigma_m**2))
        assert evidence(off_m, sigma_m).speaks_for_own(0.0) is speaks


def test_motion_as_predicted_joins_a_fragment_after_two_frames_in_a_row() -> None:
    fragment = Fragment(0.0)
    for i, off_m in enumerate([0.3, 6.0, 0.3, 0.3]):
        assert not fragment.joined
        fragment.weigh(0.5 * i, evidence(off_m))
    assert fragment.joined and JOIN_FRAMES == 2


def test_a_fragment_that_is_joined_stays_so() -> None:
    fragment = Fragment(0.0, joined=True)
    fragment.weigh(0.5, evidence(6.0))
    assert fragment.joined


def test_the_motion_of_another_flight_joins_nothing() -> None:
    fragment = Fragment(0.0)
    for i in range(20):
        fragment.weigh(0.5 * i, evidence(6.0))
    assert not fragment.joined


def test_by_chance_one_foreign_motion_in_twenty_speaks_for_the_flight() -> None:
    rng = np.random.default_rng(1)
    radius = FOREIGN_SPEED_MPS * 0.5 * np.sqrt(rng.uniform(size=4000))
    predicted = np.array([8.0, 0.0]) * 0.5
    towards = rng.uniform(0.0, 2.0 * math.pi, 4000)
    foreign = radius[:, None] * np.column_stack([np.cos(towards), np.sin(towards)])
    own = [MotionEvidence(m - predicted, np.eye(2), 0.5).speaks_for_own(0.0) for m in foreign]
    assert np.mean(own) < math.exp(-JOIN_LLR)


def test_where_velocity_is_unknown_agreement_is_all_that_can_be_asked() -> None:
    wide_m = 15.0 * 0.5
    assert evidence(0.0, wide_m).most_llr < JOIN_LLR
    assert evidence(0.99 * math.sqrt(AGREES_D2) * wide_m, wide_m).speaks_for_own(0.0)
    assert not evidence(1.01 * math.sqrt(AGREES_D2) * wide_m, wide_m).speaks_for_own(0.0)


def test_no_pose_on_a_map_that_usually_gives_one_speaks_against_a_fragment() -> None:
    hits, own = MapHits(), Fragment(0.0, joined=True)
    for _ in range(50):
        hits.looked(own, found=True)
    new = Fragment(0.0)
    for _ in range(3):
        hits.looked(new, found=False)
    assert new.map_llr == pytest.approx(3.0 * math.log(0.1))
    for i in range(10):
        new.weigh(0.5 * i, evidence(0.1))
    assert not new.joined
    hits.looked(new, found=True)
    assert new.joined


def test_the_share_of_looks_that_find_a_pose_is_learnt_over_ten_of_them() -> None:
    hits, own, new = MapHits(), Fragment(0.0, joined=True), Fragment(0.0)
    for _ in range(10):
        hits.looked(own, found=True)
    hits.looked(new, found=False)
    assert new.map_llr == pytest.approx(10.0 * math.log(0.9))
    hits.looked(own, found=False)
    assert own.map_llr == 0.0
    later = Fragment(0.0)
    hits.looked(later, found=False)
    assert later.map_llr == pytest.approx(math.log(1.0 - 0.9 * (1.0 - 0.9**10)))


def test_where_the_map_never_gives_a_pose_its_silence_says_nothing() -> None:
    hits, new = MapHits(), Fragment(0.0)
    for _ in range(20):
        hits.looked(Fragment(0.0, joined=True), found=False)
        hits.looked(new, found=False)
    assert new.map_llr == 0.0


def test_pictures_that_turn_otherwise_than_the_heading_are_not_of_this_flight() -> None:
    assert evidence(0.1).speaks_for_own(0.0)
    assert not MotionEvidence(np.array([0.1, 0.0]), 0.25 * np.eye(2), 0.5, turns_agree=False).speaks_for_own(0.0)


def test_a_fragment_that_lasts_is_the_flight_in_the_end() -> None:
    often, long = Fragment(0.0), Fragment(0.0)
    for i in range(25):
        often.weigh(0.1 * i, evidence(6.0, over_s=0.1))
    often.weigh(29.9, evidence(6.0))
    for i in range(18):
        long.weigh(31.0 + i, evidence(6.0))
    assert not often.joined and not long.joined
    often.weigh(30.0, evidence(6.0))
    long.weigh(50.0, evidence(6.0))
    assert often.joined and long.joined


def test_nodes_know_their_fragment_and_where_in_it_they_are() -> None:
    fragments, fragment = Fragments(), Fragment(0.0)
    fragment.moved_m = np.array([3.0, 4.0])
    fragments.add(7, fragment)
    fragment.moved_m = np.array([6.0, 8.0])
    fragments.add(8, fragment)
    assert fragments.of(7) is fragments.of(8) is fragment
    assert fragments.at_m(7).tolist() == [3.0, 4.0]
    fragments.keep({8})
    with pytest.raises(KeyError):
        fragments.of(7)
