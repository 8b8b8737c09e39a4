"""Fragments of odometry: whether one belongs to the flight, and whether it is joined to it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from terrafix.estimator.integrity.fragments import (
    CONFIRM_FRAMES,
    CONFIRM_LLR,
    CONSISTENT_D2,
    FOREIGN_SPEED_MPS,
    Fragment,
    Fragments,
    MapHitRate,
    MotionEvidence,
)


def evidence(off_m: float, sigma_m: float = 0.5, over_s: float = 0.5) -> MotionEvidence:
    """-> evidence of a motion that differs by ``off_m`` from the prediction, over ``over_s`` seconds."""
    return MotionEvidence(np.array([off_m, 0.0]), sigma_m**2 * np.eye(2), over_s)


def test_the_evidence_of_a_motion_is_the_ratio_of_the_two_densities() -> None:
    own = math.exp(-0.5 * (0.7 / 0.5) ** 2) / (2.0 * math.pi * 0.5**2)
    foreign = 1.0 / (math.pi * (FOREIGN_SPEED_MPS * 0.5) ** 2)
    assert evidence(0.7).llr == pytest.approx(math.log(own / foreign))


def test_motion_supports_the_flight_when_it_is_20_times_as_likely_as_a_uniform_motion_up_to_30_mps() -> None:
    sigma_m, foreign = 0.5, 1.0 / (math.pi * (30.0 * 0.5) ** 2)
    for factor, supports in ((18.0, False), (22.0, True)):
        off_m = sigma_m * math.sqrt(-2.0 * math.log(factor * foreign * 2.0 * math.pi * sigma_m**2))
        assert evidence(off_m, sigma_m).supports_same_flight(0.0) is supports


def test_motion_as_predicted_confirms_a_fragment_after_two_consecutive_frames() -> None:
    fragment = Fragment(0.0)
    for i, off_m in enumerate([0.3, 6.0, 0.3, 0.3]):
        assert not fragment.confirmed
        fragment.add_frame(0.5 * i, evidence(off_m))
    assert fragment.confirmed and CONFIRM_FRAMES == 2


@pytest.mark.parametrize(
    ("off_m", "inertial", "frames", "step_s", "confirmed", "joined"),
    [
        pytest.param(0.1, True, 3, 0.5, True, True, id="as predicted by inertial readings: joined"),
        pytest.param(0.1, False, 3, 0.5, True, False, id="as predicted without inertial readings: confirmed alone"),
        pytest.param(6.0, True, 40, 1.0, True, False, id="against inertial readings: confirmed by its duration alone"),
        pytest.param(6.0, False, 20, 0.5, False, False, id="as of another flight: neither"),
    ],
)
def test_a_fragment_is_confirmed_and_joined_by_its_motion(
    off_m: float, inertial: bool, frames: int, step_s: float, confirmed: bool, joined: bool
) -> None:
    fragment = Fragment(0.0)
    for i in range(frames):
        fragment.add_frame(step_s * i, replace(evidence(off_m), inertial=inertial))
    assert (fragment.confirmed, fragment.joined) == (confirmed, joined)


def test_a_confirmed_fragment_stays_confirmed() -> None:
    fragment = Fragment.joined_at(0.0)
    fragment.add_frame(0.5, evidence(6.0))
    assert fragment.confirmed


def test_at_most_one_foreign_motion_in_20_supports_the_flight_by_chance() -> None:
    rng = np.random.default_rng(1)
    radius = FOREIGN_SPEED_MPS * 0.5 * np.sqrt(rng.uniform(size=4000))
    predicted = np.array([8.0, 0.0]) * 0.5
    direction = rng.uniform(0.0, 2.0 * math.pi, 4000)
    foreign = radius[:, None] * np.column_stack([np.cos(direction), np.sin(direction)])
    supported = [MotionEvidence(m - predicted, np.eye(2), 0.5).supports_same_flight(0.0) for m in foreign]
    assert np.mean(supported) < math.exp(-CONFIRM_LLR)


def test_with_unknown_velocity_a_consistent_innovation_is_sufficient() -> None:
    wide_m = 15.0 * 0.5
    assert evidence(0.0, wide_m).max_llr < CONFIRM_LLR
    assert evidence(0.99 * math.sqrt(CONSISTENT_D2) * wide_m, wide_m).supports_same_flight(0.0)
    assert not evidence(1.01 * math.sqrt(CONSISTENT_D2) * wide_m, wide_m).supports_same_flight(0.0)


def test_missing_map_poses_are_evidence_against_a_fragment_if_the_map_usually_gives_poses() -> None:
    hits, own = MapHitRate(), Fragment.joined_at(0.0)
    for _ in range(50):
        hits.update(own, found=True)
    new = Fragment(0.0)
    for _ in range(3):
        hits.update(new, found=False)
    assert new.map_llr == pytest.approx(3.0 * math.log(0.1))
    for i in range(10):
        new.add_frame(0.5 * i, evidence(0.1))
    assert not new.confirmed


def test_the_map_hit_rate_is_an_average_over_ten_correlations() -> None:
    hits, own, new = MapHitRate(), Fragment.joined_at(0.0), Fragment(0.0)
    for _ in range(10):
        hits.update(own, found=True)
    hits.update(new, found=False)
    assert new.map_llr == pytest.approx(10.0 * math.log(0.9)) == pytest.approx(math.log(hits.p_nothing))
    hits.update(own, found=False)
    assert own.map_llr == 0.0
    later = Fragment(0.0)
    hits.update(later, found=False)
    assert later.map_llr == pytest.approx(math.log(1.0 - 0.9 * (1.0 - 0.9**10)))


def test_missing_map_poses_are_no_evidence_if_the_map_never_gives_poses() -> None:
    hits, new = MapHitRate(), Fragment(0.0)
    for _ in range(20):
        hits.update(Fragment.joined_at(0.0), found=False)
        hits.update(new, found=False)
    assert new.map_llr == 0.0


def test_images_whose_rotation_contradicts_the_heading_do_not_support_the_flight() -> None:
    assert evidence(0.1).supports_same_flight(0.0)
    assert not MotionEvidence(np.array([0.1, 0.0]), 0.25 * np.eye(2), 0.5, turns_agree=False).supports_same_flight(0.0)


def test_a_fragment_that_lasts_long_enough_is_confirmed_but_not_joined() -> None:
    often, long = Fragment(0.0), Fragment(0.0)
    for i in range(25):
        often.add_frame(0.1 * i, evidence(6.0, over_s=0.1))
    often.add_frame(29.9, evidence(6.0))
    for i in range(18):
        long.add_frame(31.0 + i, evidence(6.0))
    assert not often.confirmed and not long.confirmed
    often.add_frame(30.0, evidence(6.0))
    long.add_frame(50.0, evidence(6.0))
    assert often.confirmed and long.confirmed
    assert not often.joined and not long.joined


def test_fragment_and_displacement_are_stored_for_each_node() -> None:
    fragments, fragment = Fragments(), Fragment(0.0)
    fragment.displacement_m = np.array([3.0, 4.0])
    fragments.add(7, fragment)
    fragment.displacement_m = np.array([6.0, 8.0])
    fragments.add(8, fragment)
    assert fragments.of(7) is fragments.of(8) is fragment
    assert fragments.displacement_m(7).tolist() == [3.0, 4.0]
    fragments.retain({8})
    with pytest.raises(KeyError):
        fragments.of(7)


def test_images_that_contradicted_inertial_readings_are_not_confirmed_by_duration() -> None:
    fragment = Fragment(0.0)
    for i in range(1, 100):
        fragment.add_frame(float(i), None, by_duration=False)
    assert not fragment.confirmed and not fragment.joined


@pytest.mark.parametrize(("sigma_m", "joined"), [(0.5, True), (8.0, False)])
def test_contradicted_images_need_evidence_where_velocity_is_hardly_known(sigma_m: float, joined: bool) -> None:
    """For those that nothing has contradicted motion within the 50 % ellipse is sufficient then."""
    fragments = Fragment(0.0), Fragment(0.0)
    for fragment, contradicted in zip(fragments, (False, True), strict=True):
        fragment.map_llr = -2.5 if contradicted else 0.0  # said of wrong images
        for i in range(1, CONFIRM_FRAMES + 1):
            motion = replace(evidence(0.0, sigma_m), inertial=True, contradicted=contradicted)
            fragment.add_frame(float(i), motion, by_duration=not contradicted)
    assert [fragment.joined for fragment in fragments] == [True, joined]
