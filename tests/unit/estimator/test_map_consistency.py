"""Camera poses that agree neither with the flight nor with each other widen the claim; those of a true map do not."""

import numpy as np
import pytest

from terrafix.core.gate import LEAST_WEIGHT
from terrafix.estimator.integrity.map_consistency import MapConsistency

AWAY_M = np.array([90.0, -120.0])  # 150 m


def refused(consistency: MapConsistency, times: int) -> MapConsistency:
    for _ in range(times):
        consistency.refused(AWAY_M)
    return consistency


@pytest.mark.parametrize("times", [0, 1])
def test_one_refused_pose_is_a_mistake_and_widens_nothing(times: int) -> None:
    assert refused(MapConsistency(), times).variance_m2 == 0.0


def test_refused_poses_without_one_that_agrees_widen_the_claim_as_far_as_they_are() -> None:
    few, many = (refused(MapConsistency(), times) for times in (2, 6))
    assert LEAST_WEIGHT < few.probability < 0.5
    assert few.variance_m2 == pytest.approx(few.probability * 150.0**2)
    assert many.probability > 0.9 and many.variance_m2 == pytest.approx(150.0**2, rel=0.1)


@pytest.mark.parametrize("seed", range(3))
def test_a_map_on_which_a_tenth_of_the_poses_is_wrong_is_still_one_of_this_ground(seed: int) -> None:
    rng, consistency = np.random.default_rng(seed), MapConsistency()
    doubted = 0
    for _ in range(500):
        if rng.uniform() < 0.1:
            consistency.refused(AWAY_M)
        else:
            consistency.agreed(0.5)
        doubted += consistency.variance_m2 > 0.0
    assert doubted < 0.1 * 500


def test_poses_that_agree_over_new_ground_end_the_doubt_and_the_same_ground_again_does_not() -> None:
    hovering, flying = (refused(MapConsistency(), 4) for _ in range(2))
    for _ in range(10):
        hovering.agreed(0.0)
        flying.agreed(0.5)
    assert hovering.probability == refused(MapConsistency(), 4).probability
    assert flying.variance_m2 == 0.0


def test_what_was_refused_long_ago_says_nothing_of_where_poses_are_refused_now() -> None:
    consistency = refused(MapConsistency(), 1)
    for _ in range(20):
        consistency.agreed(1.0)
    for _ in range(4):
        consistency.refused(0.1 * AWAY_M)
    assert consistency.variance_m2 == pytest.approx(consistency.probability * 15.0**2)
