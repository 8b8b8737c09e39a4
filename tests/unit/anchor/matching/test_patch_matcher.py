"""Patch matcher: sub-cell accuracy, and no match where the maximum is not unique."""

import numpy as np
import pytest

from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.anchor.matching.patch_matcher import PatchMatches, match_patches
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import PINHOLE, FlatMap, rotation, texture, view

AGL_M = 100.0
GSD_M = 0.5
PATCH, REACH = 40, 10
HERE_M = np.array([12.0, -9.0, AGL_M])


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(4, 360.0)


def matched(ground: np.ndarray, world: FlatMap, expected_m: tuple[float, float]) -> PatchMatches:
    """The frame taken at HERE_M, searched on ``world`` around ``expected_m``."""
    r, describer = rotation(25.0), GradientDescriber()
    frame = rectify(view(ground, PINHOLE, r, HERE_M), PINHOLE, r, AGL_M, GSD_M)
    assert frame is not None
    h, w = frame.mask.shape
    margin = (REACH + 2) * GSD_M
    window, valid, e_min, n_max = MapFeatures(world, describer).window(
        expected_m[0] + frame.e_min_m - margin,
        expected_m[1] + frame.n_max_m + margin,
        w + 2 * REACH + 4,
        h + 2 * REACH + 4,
        GSD_M,
    )
    template = describer.describe(frame.image)
    return match_patches(template, frame, frame.mask, GSD_M, window, valid, (e_min, n_max), expected_m, PATCH, REACH)


@pytest.mark.parametrize("shift_m", [(0.0, 0.0), (0.13, -0.21), (1.4, 2.3), (-3.1, 0.7)])
def test_a_shift_is_found_to_a_fraction_of_a_cell(ground: np.ndarray, shift_m: tuple[float, float]) -> None:
    found = matched(ground, FlatMap(ground, shift_m), (float(HERE_M[0]), float(HERE_M[1])))
    offsets = found.map_m - (found.frame_m + HERE_M[:2])
    assert len(offsets) >= 12
    assert np.median(offsets, axis=0) == pytest.approx(shift_m, abs=0.15 * GSD_M)
    assert np.median(np.linalg.norm(offsets - shift_m, axis=1)) < 0.35 * GSD_M
    assert (found.weight > 0).all() and (found.weight <= 1).all()


def test_the_result_does_not_depend_on_the_predicted_position_within_the_search_radius(ground: np.ndarray) -> None:
    found = matched(ground, FlatMap(ground), (float(HERE_M[0]) + 2.7, float(HERE_M[1]) - 3.3))
    offsets = found.map_m - (found.frame_m + HERE_M[:2])
    assert len(offsets) >= 12
    assert np.median(np.linalg.norm(offsets, axis=1)) < 0.4 * GSD_M


def test_patches_come_from_all_over_the_frame(ground: np.ndarray) -> None:
    found = matched(ground, FlatMap(ground), (float(HERE_M[0]), float(HERE_M[1])))
    assert (np.ptp(found.frame_m, axis=0) > (60.0, 30.0)).all()


def test_another_place_gives_few_and_inconsistent_matches(ground: np.ndarray) -> None:
    right = matched(ground, FlatMap(ground), (float(HERE_M[0]), float(HERE_M[1])))
    wrong = matched(ground, FlatMap(texture(77, 360.0)), (float(HERE_M[0]), float(HERE_M[1])))
    assert len(wrong.weight) < 0.7 * len(right.weight)
    if len(wrong.weight):
        assert wrong.weight.mean() < 0.5 * right.weight.mean()
        scatter = wrong.map_m - (wrong.frame_m + HERE_M[:2])
        assert np.ptp(scatter, axis=0).max() > 2.0  # the matches are inconsistent


def test_patches_off_the_map_give_no_match(ground: np.ndarray) -> None:
    found = matched(ground, FlatMap(ground, (900.0, 0.0)), (float(HERE_M[0]), float(HERE_M[1])))
    assert found.frame_m.shape == (0, 2) and found.map_m.shape == (0, 2) and len(found.weight) == 0


def test_ground_without_texture_gives_no_match() -> None:
    water = np.full((1440, 1440, 3), 90, np.uint8)
    found = matched(water, FlatMap(water), (float(HERE_M[0]), float(HERE_M[1])))
    assert len(found.weight) == 0
