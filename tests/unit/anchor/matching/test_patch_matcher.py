"""Patch matcher: sub-cell accuracy, and no match where the maximum is not unique."""

import numpy as np
import pytest

from terrafix.anchor.matching.descriptor_cache import MapFeatures
from terrafix.anchor.matching.orthorectify import rectify
from terrafix.anchor.matching.patch_matcher import PatchMatches, SearchedMap, _peaks, correlate_patches, match_patches
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
    searched = SearchedMap(window, valid, (e_min, n_max))
    return match_patches(template, frame, frame.mask, GSD_M, searched, expected_m, PATCH, REACH)


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


@pytest.mark.parametrize("channels", [3, 8])
def test_a_surface_of_a_patch_is_its_zero_mean_normalised_correlation_with_the_map(channels: int) -> None:
    patch, radius, row0, column0 = 12, 5, 9, 7
    rng = np.random.default_rng(channels)
    window = (1.0 + rng.normal(size=(channels, 50, 60))).astype(np.float32)
    template = (2.0 + rng.normal(size=(channels, 30, 40))).astype(np.float32)
    every = np.ones(template.shape[1:], bool), np.ones(window.shape[1:], bool)
    corners, _, surfaces = correlate_patches(template, every[0], window, every[1], patch, radius, row0, column0)
    assert len(corners) >= 8 and surfaces.shape == (len(corners), 11, 11)
    for (r, c), surface in zip(corners, surfaces, strict=True):
        ours = template[:, r : r + patch, c : c + patch].astype(float)
        ours -= ours.mean(axis=(1, 2), keepdims=True)
        for dr, dc in ((0, 0), (5, 5), (10, 3), (2, 10)):
            top, left = row0 + r - radius + dr, column0 + c - radius + dc
            under = window[:, top : top + patch, left : left + patch].astype(float)
            under -= under.mean(axis=(1, 2), keepdims=True)
            expected = (ours * under).sum() / np.sqrt((ours**2).sum() * (under**2).sum())
            assert surface[dr, dc] == pytest.approx(expected, abs=1e-4)


def test_the_weight_of_a_peak_falls_to_zero_where_it_stops_to_count() -> None:
    """At the border of the search, next to an equal peak, and at the least correlation: a match that is there by the
    last bit counts as one that is not."""

    def weight(height: float, column: int, other: float = -1.0) -> float:
        surface = np.zeros((1, 21, 21), np.float32)
        surface[0, 3:8, 3:8], surface[0, 10, column] = max(other, 0.0), height
        found = _peaks(surface, np.zeros(2))
        return float(found.weight.sum())

    assert weight(0.6, 10) == pytest.approx(0.36)
    assert 0.0 < weight(0.201, 10) < 0.01 * weight(0.3, 10)
    assert weight(0.6, 19) == 0.0 < weight(0.6, 18) < weight(0.6, 17) == weight(0.6, 10)
    assert weight(0.6, 10, other=0.59) == 0.0 < weight(0.6, 10, other=0.5)


def test_a_patch_at_the_rim_counts_by_how_much_of_it_the_frame_shows() -> None:
    rng = np.random.default_rng(3)
    template, window = (rng.normal(size=(2, side, side)).astype(np.float32) for side in (40, 80))
    mask, valid = np.ones((40, 40), bool), np.ones((80, 80), bool)
    mask[:, :1] = False
    centres = np.array([(20.0, 10.0), (20.0, 20.0)])
    corners, weights, _ = correlate_patches(template, mask, window, valid, 20, 4, 20, 20, centres)
    assert sorted(corners) == [(10, 10)]  # a twentieth of the other is outside
    mask[:30, 0] = True
    corners, weights, _ = correlate_patches(template, mask, window, valid, 20, 4, 20, 20, centres)
    assert dict(zip(corners, weights.tolist(), strict=True)) == {(10, 0): 1.0, (10, 10): 1.0}
    mask[17:, 0] = False
    corners, weights, _ = correlate_patches(template, mask, window, valid, 20, 4, 20, 20, centres)
    assert dict(zip(corners, weights.tolist(), strict=True))[10, 0] == pytest.approx(1.0 - 13 / 400 / 0.04, abs=1e-3)
