"""Images that have contradicted inertial readings, and what ends that."""

import math

import numpy as np
import pytest

from terrafix.estimator.integrity.contradicted_images import ContradictedImages, MatchedFrame, WrongVelocity
from terrafix.estimator.integrity.fragments import CONFIRM_LLR, Fragment
from terrafix.estimator.models.motion_model import WorldAcceleration, integrate_motion, stationary_motion_cov

AHEAD, NOISE = np.array([0.0, 10.0]), 0.04 * np.eye(2)


def shown(off_mps: tuple[float, float], velocity_mps: np.ndarray = AHEAD) -> WrongVelocity:
    return WrongVelocity(np.array(off_mps), NOISE, velocity_mps)


def squeezed_for(frames: int) -> ContradictedImages:
    """Images that show a velocity ahead larger by a third, by readings that are good to 1 m/s."""
    images = ContradictedImages()
    images.begin(stationary_motion_cov())
    for _ in range(frames):
        assert images.right_llr(shown((0.0, 3.3)), np.eye(2)) < 0.0
    return images


def test_images_that_return_to_the_velocity_of_inertial_readings_are_right() -> None:
    images = squeezed_for(5)
    assert images.right_llr(shown((0.3, 0.9)), np.eye(2)) > CONFIRM_LLR
    assert images.right_llr(shown((0.3, 0.9)), np.eye(2)) > CONFIRM_LLR  # what they were is not forgotten
    assert images.right_llr(shown((0.0, 3.3)), np.eye(2)) < 0.0


@pytest.mark.parametrize(
    "velocity_mps",
    [np.zeros(2), np.array([10.0, 0.0]), -AHEAD, np.array([5.1, 8.6])],
    ids=["hover", "aside", "back", "31"],
)
def test_squeezed_images_show_nothing_in_another_direction_or_in_hover(velocity_mps: np.ndarray) -> None:
    assert squeezed_for(5).right_llr(shown((0.0, 0.0), velocity_mps), np.eye(2)) < CONFIRM_LLR


def test_squeezed_images_stay_wrong_at_any_speed_and_while_inertial_readings_drift() -> None:
    images = squeezed_for(5)
    for i in range(40):
        speed_mps = 10.0 + 5.0 * math.sin(0.1 * i)
        assert images.right_llr(shown((0.02 * i, 0.33 * speed_mps), speed_mps / 10.0 * AHEAD), np.eye(2)) < 0.0


def test_before_anything_was_shown_nothing_says_how_wrong_images_would_be() -> None:
    images = ContradictedImages()
    images.begin(stationary_motion_cov())
    assert images.right_llr(shown((0.0, 0.0)), np.eye(2)) == -math.inf


@pytest.mark.parametrize("has_readings", [True, False])
def test_only_inertial_readings_carry_a_velocity_on(has_readings: bool) -> None:
    images = squeezed_for(2)
    s_s = np.linspace(0.0, 0.5, 26)
    readings = WorldAcceleration(s_s, np.zeros((26, 3)), np.zeros(26), 0.03)
    imu = readings if has_readings else None
    images.propagate(integrate_motion(0.5, imu, (0.0, 0.0), 0.0, 10.0, math.radians(1.0), same_source=True))
    assert (images.inertial_cov is not None) == has_readings
    if images.inertial_cov is not None:
        assert images.inertial_cov[0, 0] > stationary_motion_cov()[0, 0]


def test_a_map_match_moves_the_velocity_of_the_graph_too() -> None:
    images = squeezed_for(2)
    images.on_map_match(MatchedFrame(0.0, Fragment(0.0), np.zeros(2), np.zeros(2), np.eye(2)))
    assert images.active and images.inertial_cov is None


def matched(
    images: ContradictedImages, ways_m: list[float], scale: float, fragments: list[Fragment], *, every_s: float = 1.0
) -> list[bool]:
    """Whether the images are contradicted after each of the map matches at ``ways_m`` east of the first, good to 2 m,
    where odometry shows a share ``scale`` of the way."""
    active = []
    for i, (way_m, fragment) in enumerate(zip(ways_m, fragments, strict=True)):
        east = np.array([1.0, 0.0])
        images.on_map_match(MatchedFrame(every_s * i, fragment, scale * way_m * east, way_m * east, 4.0 * np.eye(2)))
        active.append(images.active)
    return active


def contradicted() -> tuple[ContradictedImages, Fragment]:
    images = ContradictedImages()
    images.begin()
    return images, Fragment(0.0)


def test_contradicted_images_are_right_again_where_they_agree_with_the_way_between_two_map_matches() -> None:
    images, fragment = contradicted()
    assert matched(images, [0.0, 40.0, 80.0, 120.0], 1.02, [fragment] * 4) == [True, True, False, False]
    assert fragment.joined


@pytest.mark.parametrize("scale", [0.75, 4.0 / 3.0])
def test_squeezed_images_stay_contradicted_wherever_the_map_shows_them(scale: float) -> None:
    images, fragment = contradicted()
    assert all(matched(images, [20.0 * i for i in range(60)], scale, [fragment] * 60))
    assert not fragment.confirmed
    after = Fragment(0.0)
    images.on_map_match(MatchedFrame(60.0, after, np.zeros(2), np.array([1200.0, 0.0]), np.eye(2)))
    assert matched(images, [1260.0], 1.0, [after], every_s=0.0) == [True]  # another origin of its displacement


def test_a_way_between_two_fragments_tells_nothing_of_the_images() -> None:
    images, fragment = contradicted()
    others = [fragment, Fragment(1.0), Fragment(2.0)]
    assert matched(images, [0.0, 100.0, 200.0], 1.0, others) == [True, True, True]


def test_over_one_place_contradicted_images_are_believed_again_after_the_time_that_confirms_a_fragment() -> None:
    images, fragment = contradicted()
    active = matched(images, [0.1 * i for i in range(32)], 1.0, [fragment] * 32)
    assert active == [True] * 30 + [False] * 2
