"""Images that repeat an earlier one are detected despite sensor noise, and images with motion are not."""

import cv2
import numpy as np
import pytest

from terrafix.vision.repeated_picture import (
    HISTORY,
    MAX_SHIFT_PX,
    WIDTH_PX,
    PictureHistory,
    Repeat,
    normal_equations,
    same_view,
)

SIDE = 720


def ground(seed: int) -> np.ndarray:
    """(SIDE, 2 SIDE) uint8 with detail of all sizes."""
    rng = np.random.default_rng(seed)
    image = sum(
        cv2.resize(rng.normal(0.0, 12.0, (SIDE // cell, 2 * SIDE // cell)), (2 * SIDE, SIDE)) for cell in (4, 12, 40)
    )
    return np.clip(128.0 + image, 0, 255).astype(np.uint8)


def noisy(image: np.ndarray, seed: int, sigma: float = 3.0) -> np.ndarray:
    return np.clip(image + np.random.default_rng(seed).normal(0.0, sigma, image.shape), 0, 255).astype(np.uint8)


def view(image: np.ndarray, x_px: float, y_px: float = 0.0) -> np.ndarray:
    """(480, 720): a window of the ground."""
    return cv2.warpAffine(image, np.array([[1.0, 0.0, -x_px], [0.0, 1.0, -y_px]]), (720, 480), flags=cv2.INTER_CUBIC)


def looks(pictures: list[np.ndarray]) -> list[Repeat]:
    history = PictureHistory()
    return [history.classify(picture) for picture in pictures]


def test_the_same_image_with_new_noise_is_the_same_view() -> None:
    still = view(ground(1), 10.0)
    assert looks([noisy(still, i) for i in range(6)]) == [Repeat.NONE] + [Repeat.PREVIOUS] * 5


def test_equal_pixels_are_identical() -> None:
    still = view(ground(1), 10.0)
    assert looks([still, still.copy()]) == [Repeat.NONE, Repeat.IDENTICAL]


def test_cycling_stale_buffers_are_detected_from_the_first_one() -> None:
    place = ground(2)
    flown = [noisy(view(place, 6.0 * i), i) for i in range(8)]
    cycled = [noisy(view(place, 6.0 * (4 + i % 4)), 100 + i) for i in range(8)]
    repeats = looks(flown + cycled)
    assert repeats[:8] == [Repeat.NONE] * 8
    assert repeats[8:] == [Repeat.OLDER] * 8


@pytest.mark.parametrize(
    "away", [(4.0 * MAX_SHIFT_PX, 0.0), (0.0, 4.0 * MAX_SHIFT_PX), (0.5, 0.5), (3.0, 0.0), (40.0, 0.0)]
)
def test_a_displaced_view_is_not_the_same_view(away: tuple[float, float]) -> None:
    """``away`` in pixels of the compared copies; one of them is two pixels of these images."""
    place, factor = ground(3), 720 / WIDTH_PX
    moved = view(place, 20.0 + factor * away[0], factor * away[1])
    assert looks([noisy(view(place, 20.0), 1), noisy(moved, 2)]) == [Repeat.NONE, Repeat.NONE]


def test_a_rotation_about_the_centre_is_motion_despite_zero_mean_displacement() -> None:
    still = view(ground(4), 10.0)
    turn = cv2.getRotationMatrix2D((359.5, 239.5), 0.1, 1.0)
    assert not same_view(cv2.resize(still, (360, 240)), cv2.resize(cv2.warpAffine(still, turn, (720, 480)), (360, 240)))


def test_unrelated_images_are_not_the_same_view() -> None:
    assert looks([noisy(view(ground(i), 0.0), i) for i in range(12)]) == [Repeat.NONE] * 12


def test_black_images_have_no_measurable_displacement() -> None:
    black = np.full((480, 720), 8, np.uint8)
    assert looks([noisy(black, i) for i in range(3)]) == [Repeat.NONE] * 3


def test_an_image_older_than_the_history_counts_as_new() -> None:
    place = ground(5)
    flown = [noisy(view(place, 4.0 * i), i) for i in range(HISTORY + 2)]
    assert looks([*flown, noisy(view(place, 0.0), 99)])[-1] is Repeat.NONE
    assert looks([*flown[:HISTORY], noisy(view(place, 0.0), 99)])[-1] is Repeat.OLDER


@pytest.mark.parametrize("towards", [(1.0, 0.0), (0.0, 1.0)])
def test_a_sway_of_0_008_degrees_is_motion_and_half_of_it_is_not(
    towards: tuple[float, float],
) -> None:
    """With a field of view of 90 degrees over 720 px. OpenCV warps in steps of 1/32 px."""
    place = ground(6)
    for sway_px, repeats in ((2.0 / 32.0, Repeat.NONE), (1.0 / 32.0, Repeat.PREVIOUS)):
        moved = view(place, 20.0 + sway_px * towards[0], sway_px * towards[1])
        assert looks([noisy(view(place, 20.0), 1), noisy(moved, 2)])[1] is repeats


@pytest.mark.parametrize(("row", "column"), [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_motion_in_one_quadrant_is_motion(row: int, column: int) -> None:
    still, moved = cv2.resize(view(ground(7), 10.0), (360, 240)), cv2.resize(view(ground(7), 12.0), (360, 240))
    now = still.copy()
    quarter = slice(120 * row, 120 * (row + 1)), slice(180 * column, 180 * (column + 1))
    now[quarter] = moved[quarter]
    assert same_view(still, still) and not same_view(still, now)


def test_fog_with_dark_edges_has_no_measurable_displacement() -> None:
    """Such images are similar, but they have no texture that could show motion."""
    y, x = np.mgrid[-1.0:1.0:480j, -1.0:1.0:720j]
    fog = 150.0 - 40.0 * (x**2 + y**2)
    assert looks([noisy(fog, i, 1.0) for i in range(3)]) == [Repeat.NONE] * 3


def test_a_frozen_image_of_low_contrast_is_detected() -> None:
    faint = 128.0 + 0.15 * (view(ground(8), 10.0) - 128.0)
    assert looks([noisy(faint, i, 0.5) for i in range(3)]) == [Repeat.NONE, Repeat.PREVIOUS, Repeat.PREVIOUS]


def test_two_alternating_buffers_are_detected_at_the_third_image() -> None:
    first, second = view(ground(9), 0.0), view(ground(9), 30.0)
    repeats = looks([noisy(first, 1), noisy(second, 2), noisy(first, 3), noisy(second, 4)])
    assert repeats == [Repeat.NONE, Repeat.NONE, Repeat.OLDER, Repeat.OLDER]


def test_images_of_different_size_are_not_the_same_view() -> None:
    still = view(ground(1), 10.0)
    assert looks([noisy(still, 1), noisy(still[:400], 2)]) == [Repeat.NONE, Repeat.NONE]


def test_the_normal_equations_are_exact_so_that_all_processors_agree() -> None:
    """Steps between black and white, the largest gradients that there are: the sums are those of whole numbers."""
    rng = np.random.default_rng(10)
    before, now = (rng.choice([0, 255], (120, 180)).astype(np.float32) for _ in range(2))
    gradient = np.stack([cv2.Scharr(before, cv2.CV_32F, x, 1 - x, scale=1 / 32).ravel() for x in (1, 0)])
    whole, difference = (32 * gradient).astype(np.int64), (now - before).astype(np.int64).ravel()
    assert np.abs(whole).max() > 4000 and np.array_equal(whole, 32 * gradient)
    with np.errstate(all="raise"):
        normal, right = normal_equations(gradient, (now - before).ravel())
    assert np.array_equal(normal * 1024, whole @ whole.T)
    assert np.array_equal(right * 32, whole @ difference)
