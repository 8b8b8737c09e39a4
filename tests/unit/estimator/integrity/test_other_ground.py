"""Camera poses inconsistent with the flight and with each other inflate the covariance; those of a true map do not."""

import numpy as np
import pytest

from terrafix.core.agreement import WRONG_SCORE, Agreement, Cause
from terrafix.core.gate import GATE, MIN_COMPONENT_WEIGHT
from terrafix.estimator.integrity.innovation import Innovation
from terrafix.estimator.integrity.other_ground import OtherGround

OFFSET_M = np.array([90.0, -120.0])  # 150 m
HEIGHT_M = 100.0
NEAR_M = np.array([2.0, -1.0])
NARROW_M2 = 5.0**2 * np.eye(2)  # innovation covariance of an estimate that is placed


def innovation(offset_m: np.ndarray, covariance_m2: np.ndarray) -> Innovation:
    return Innovation(offset_m, covariance_m2, GATE[2])


def probability(ground: OtherGround) -> float:
    return ground.agreement.probability(Cause.OTHER_GROUND)


def after_rejected(consistency: OtherGround, times: int) -> OtherGround:
    for _ in range(times):
        consistency.on_rejected(OFFSET_M)
    return consistency


@pytest.mark.parametrize("times", [0, 1])
def test_a_single_rejected_pose_does_not_inflate_the_covariance(times: int) -> None:
    assert after_rejected(OtherGround(Agreement()), times).variance_m2 == 0.0


def test_rejected_poses_without_accepted_ones_inflate_the_covariance_to_their_distance() -> None:
    few, many = (after_rejected(OtherGround(Agreement()), times) for times in (2, 6))
    assert MIN_COMPONENT_WEIGHT < probability(few) < 0.5
    assert few.variance_m2 == pytest.approx(probability(few) * 150.0**2)
    assert probability(many) > 0.9 and many.variance_m2 == pytest.approx(150.0**2, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_with_a_tenth_of_wrong_poses_is_not_taken_for_another_place(seed: int) -> None:
    rng, consistency = np.random.default_rng(seed), OtherGround(Agreement())
    inflated = 0
    for _ in range(500):
        if rng.uniform() < 0.1:
            consistency.on_rejected(OFFSET_M)
        else:
            consistency.on_pose(0.5, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
        inflated += consistency.variance_m2 > 0.0
    assert inflated < 0.1 * 500


def test_accepted_poses_end_the_inflation_only_over_new_ground() -> None:
    hovering, flying = (after_rejected(OtherGround(Agreement()), 4) for _ in range(2))
    for _ in range(10):
        hovering.on_pose(0.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
        flying.on_pose(0.5, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
    assert probability(hovering) == probability(after_rejected(OtherGround(Agreement()), 4))
    assert flying.variance_m2 == 0.0


def test_a_frame_that_fits_better_than_any_wrong_place_ends_the_inflation_over_new_ground_alone() -> None:
    for score, share, ends in (
        (WRONG_SCORE, 1.0, False),
        (WRONG_SCORE + 3.0, 0.1, False),
        (WRONG_SCORE + 3.0, 1.0, True),
    ):
        ground = after_rejected(OtherGround(Agreement()), 6)
        before_m2 = ground.variance_m2
        ground.on_score(share, score)
        assert (ground.variance_m2 == 0.0) if ends else (ground.variance_m2 > 0.9 * before_m2)


def test_the_distance_of_earlier_rejected_poses_is_forgotten_after_accepted_ones() -> None:
    consistency = after_rejected(OtherGround(Agreement()), 1)
    for _ in range(20):
        consistency.on_pose(1.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
    for _ in range(4):
        consistency.on_rejected(0.1 * OFFSET_M)
    assert consistency.variance_m2 == pytest.approx(probability(consistency) * 15.0**2)


@pytest.mark.parametrize(("sigma_m", "ends"), [(5.0, True), (300.0, False)])
def test_poses_inside_a_gate_wider_than_the_rejected_ones_do_not_end_the_inflation(sigma_m: float, ends: bool) -> None:
    consistency = after_rejected(OtherGround(Agreement()), 4)
    before_m2 = consistency.variance_m2
    for _ in range(5):
        consistency.on_pose(1.0, innovation(NEAR_M, sigma_m**2 * np.eye(2)), HEIGHT_M)
    assert (consistency.variance_m2 == 0.0) if ends else (consistency.variance_m2 > 0.9 * before_m2)


def test_after_many_rejected_poses_four_accepted_ones_over_new_ground_end_the_inflation() -> None:
    """The evidence against a map is bounded: a long flight over changed ground must not outweigh the map after it."""
    consistency = after_rejected(OtherGround(Agreement()), 200)
    for _ in range(3):
        consistency.on_pose(1.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
        assert consistency.variance_m2 > 0.0
    consistency.on_pose(1.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
    assert consistency.variance_m2 == 0.0


def test_after_any_number_of_accepted_poses_three_rejected_ones_inflate_the_covariance() -> None:
    """The evidence for a map is bounded, too: a map that was right for a long way can still end."""
    consistency = OtherGround(Agreement())
    for _ in range(500):
        consistency.on_pose(1.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
    assert probability(after_rejected(consistency, 3)) > 0.5


def test_ground_that_shows_nothing_widens_no_claim_and_makes_the_first_pose_of_a_wide_gate_doubtful() -> None:
    """Dead reckoning has led 290 m astray, and a pose puts the flight 400 m away: the claim reaches back."""
    ground, wide = OtherGround(Agreement()), innovation(np.array([400.0, 0.0]), 290.0**2 * np.eye(2))
    for i in range(8):
        ground.on_nothing(np.array([30.0 * i, 0.0]), HEIGHT_M, 0.2)
    assert ground.variance_m2 == 0.0
    ground.on_pose(1.0, wide, HEIGHT_M)
    assert ground.variance_m2 == pytest.approx(probability(ground) * (400.0**2 + 2.0 * 290.0**2))
    assert probability(ground) > 0.9
    for _ in range(4):
        ground.on_pose(1.0, innovation(NEAR_M, NARROW_M2), HEIGHT_M)
    assert ground.variance_m2 == 0.0  # four poses over new ground agree
    known = OtherGround(Agreement())  # no frame has shown nothing
    known.on_pose(1.0, wide, HEIGHT_M)
    assert known.variance_m2 == 0.0


@pytest.mark.parametrize(("p_nothing", "grows"), [(0.1, True), (0.8, False), (0.95, False)])
def test_ground_that_shows_nothing_counts_by_the_hit_rate_of_the_flight_and_once_a_place(
    p_nothing: float, *, grows: bool
) -> None:
    flying, hovering = OtherGround(Agreement()), OtherGround(Agreement())
    for i in range(6):
        flying.on_nothing(np.array([0.0, 26.0 * i]), HEIGHT_M, p_nothing)
        hovering.on_nothing(np.array([0.0, 4.0 * i]), HEIGHT_M, p_nothing)
    odds = flying.agreement.log_odds[Cause.OTHER_GROUND]
    assert (odds > 0.0) == grows
    assert hovering.agreement.log_odds[Cause.OTHER_GROUND] == pytest.approx(-6.0 + max(0.0, np.log(0.8 / p_nothing)))


def test_a_pose_that_was_fused_outside_of_the_gate_of_its_position_is_no_evidence_for_the_map() -> None:
    consistency = after_rejected(OtherGround(Agreement()), 4)
    before = probability(consistency)
    consistency.on_pose(
        1.0, innovation(np.array([5.0 * 3.8, 0.0]), NARROW_M2), HEIGHT_M
    )  # the gate ends at 3.72 sigmas
    assert probability(consistency) == before
    consistency.on_pose(1.0, innovation(np.array([5.0 * 3.6, 0.0]), NARROW_M2), HEIGHT_M)
    assert probability(consistency) < before
