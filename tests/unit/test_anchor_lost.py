"""What a pose says for the place where it was found."""

import math

import pytest

from terrafix.anchor.lost import LEAST_POSE_GAIN, pose_gain, pose_likelihood_ratio


@pytest.mark.parametrize(
    ("inliers", "nats"), [(7, 0.0), (8, 3.0), (11, 3.0), (12, 5.0), (19, 5.0), (20, 6.0), (48, 6.0)]
)
def test_a_pose_says_the_more_the_more_patches_agree(inliers: int, nats: float) -> None:
    assert pose_gain(inliers) == nats
    assert math.log(pose_likelihood_ratio(inliers)) == pytest.approx(max(nats, LEAST_POSE_GAIN))
