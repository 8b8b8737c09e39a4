"""What a pose says for the place where it was found."""

import math

import pytest

from terrafix.anchor.lost import LEAST_POSE_GAIN, pose_gain, pose_likelihood_ratio


@pytest.mark.parametrize(
    ("inliers", "nats"), [(7, 0.0), (8, 3.0), (11, 3.0), (12, 5.0), (19, 5.0), (20, 6.0), (48, 6.0)]
)
def test_a_pose_says_the_more_the_more_patches_agree(inliers: int, nats: float) -> None:
    assert pose_gain(inliers) == nats
    assert math.log(pose_likelihood_ratio(inliers, 1.0)) == pytest.approx(max(nats, LEAST_POSE_GAIN))


def test_over_ground_that_was_just_seen_a_pose_says_less_than_over_new_one() -> None:
    assert math.log(pose_likelihood_ratio(48, 0.75)) == pytest.approx(4.5)
    assert math.log(pose_likelihood_ratio(48, 0.1)) == pytest.approx(LEAST_POSE_GAIN)
