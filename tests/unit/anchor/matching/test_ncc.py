"""Normalised correlation of dense descriptors: exact position, NaN off the map, no amplification of flat ground."""

import cv2
import numpy as np
import pytest

from terrafix.anchor.matching.ncc import CorrelationWindow, _quantiles, standardise
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import texture


def descriptors(seed: int, channels: int = 4, height: int = 120, width: int = 150) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.3, 1.0, (channels, height, width)).astype(np.float32)


WHOLE = np.ones((30, 40), bool)


@pytest.mark.parametrize(("row", "column"), [(0, 0), (17, 53), (90, 110)])
def test_a_known_shift_is_found_to_the_cell(row: int, column: int) -> None:
    window = descriptors(1)
    noise = np.random.default_rng(2).normal(0.0, 0.7, (4, 30, 40))
    template = (window[:, row : row + 30, column : column + 40] + noise).astype(np.float32)
    surface = CorrelationWindow(window, np.ones(window.shape[1:], bool)).correlate(template, WHOLE)
    assert surface.shape == (91, 111)
    assert np.unravel_index(int(np.argmax(surface)), surface.shape) == (row, column)
    assert 0.6 < surface.max() <= 1.0 and surface.min() >= -1.0
    assert standardise(surface).max() > 8.0


def test_perfect_agreement_is_one_independent_of_brightness() -> None:
    window = descriptors(3)
    template = 3.0 * window[:, 20:50, 30:70] + 2.0
    surface = CorrelationWindow(window, np.ones(window.shape[1:], bool)).correlate(template, WHOLE)
    assert float(surface[20, 30]) == pytest.approx(1.0, abs=1e-3)
    opposite = CorrelationWindow(window, np.ones(window.shape[1:], bool)).correlate(-template, WHOLE)
    assert float(opposite[20, 30]) == pytest.approx(-1.0, abs=1e-3)


def direct(window: np.ndarray, template: np.ndarray, mask: np.ndarray, row: int, column: int) -> float:
    """Zero-mean normalised correlation at one place, by its definition."""
    h, w = mask.shape
    a, b = (
        x[:, mask] - x[:, mask].mean(1, keepdims=True)
        for x in (template, window[:, row : row + h, column : column + w])
    )
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))


def test_the_fft_result_equals_direct_summation_for_descriptors_of_an_image() -> None:
    ground = texture(3, 60.0)[:160, :190]
    window = GradientDescriber().describe(ground)
    seen = cv2.warpAffine(ground, cv2.getRotationMatrix2D((80.0, 80.0), 3.0, 1.02), (190, 160))
    template = GradientDescriber().describe(seen)[:, 30:101, 40:125]
    rows, columns = np.mgrid[0:71, 0:85]
    mask = np.abs(rows - 35.0) / 35.0 + np.abs(columns - 42.0) / 42.0 < 1.3  # a rectangle with cut corners
    surface = CorrelationWindow(window, np.ones(window.shape[1:], bool)).correlate(template, mask)
    for row, column in ((0, 0), (31, 40), (30, 41), (57, 3), (89, 105)):
        assert float(surface[row, column]) == pytest.approx(direct(window, template, mask, row, column), abs=1e-3)


def test_white_noise_under_a_mask_of_single_cells_is_normalised_to_four_per_cent() -> None:
    """The worst case for local sums of 2 x 2 cells; descriptors are smooth, and masks have long edges."""
    window, rng = descriptors(4, 3, 40, 50), np.random.default_rng(5)
    mask = rng.random((12, 15)) > 0.3
    template = rng.normal(size=(3, 12, 15)).astype(np.float32)
    surface = CorrelationWindow(window, np.ones((40, 50), bool)).correlate(template, mask)
    for row, column in ((0, 0), (11, 20), (28, 35)):
        expected = direct(window, template, mask, row, column)
        assert float(surface[row, column]) == pytest.approx(expected, rel=0.04)


def test_masked_cells_do_not_count() -> None:
    window = descriptors(6)
    template = window[:, 40:70, 60:100].copy()
    mask = WHOLE.copy()
    mask[:10] = False
    template[:, :10] = 50.0  # an unmasked bar of large values, such as a wing or the edge of the frame
    surface = CorrelationWindow(window, np.ones(window.shape[1:], bool)).correlate(template, mask)
    assert np.unravel_index(int(np.argmax(surface)), surface.shape) == (40, 60)


def test_cells_off_the_map_are_nan() -> None:
    window, valid = descriptors(7), np.ones((120, 150), bool)
    valid[:, :60] = False
    window[:, ~valid] = 0.0
    surface = CorrelationWindow(window, valid).correlate(window[:, 50:80, 100:140], WHOLE)
    assert np.isnan(surface[:, :40]).all()  # less than 60 % on the map
    assert np.isfinite(surface[:, 61:]).all()
    assert np.unravel_index(int(np.nanargmax(surface)), surface.shape) == (50, 100)
    nowhere = CorrelationWindow(np.zeros_like(window), np.zeros_like(valid)).correlate(window[:, 50:80, 100:140], WHOLE)
    assert np.isnan(nowhere).all()


def test_flat_ground_is_not_amplified() -> None:
    """Water beside land: noise a hundred times weaker than the template must not correlate."""
    window = descriptors(8)
    template = window[:, 20:50, 20:60].copy()
    window[:, :, 75:] = 0.01 * np.random.default_rng(9).normal(size=(4, 120, 75))
    surface = CorrelationWindow(window, np.ones((120, 150), bool)).correlate(template, WHOLE)
    assert np.abs(surface[:, 80:]).max() < 0.05


def test_a_blank_frame_over_a_blank_map_has_no_correlation() -> None:
    window = np.zeros((4, 120, 150), np.float32)
    blank = CorrelationWindow(window, np.ones((120, 150), bool)).correlate(np.zeros((4, 30, 40), np.float32), WHOLE)
    assert np.abs(np.nan_to_num(blank)).max() < 1e-3


def test_random_alignment_is_standardised_to_zero_mean_and_unit_sigma() -> None:
    noise = np.random.default_rng(10).normal(0.02, 0.05, (200, 200)).astype(np.float32)
    noise[:20] = np.nan
    z = standardise(noise)
    assert np.isnan(z[:20]).all()
    assert (float(np.nanmedian(z)), float(np.nanstd(z))) == pytest.approx((0.0, 1.0), abs=0.05)


def test_a_surface_with_many_similar_places_has_no_high_peak() -> None:
    rng = np.random.default_rng(11)
    surface = rng.normal(0.0, 0.03, (200, 200)).astype(np.float32)
    surface.ravel()[rng.choice(40_000, 800, replace=False)] = 0.5  # streets that correlate with many wrong places
    assert standardise(surface).max() < 4.0


def test_a_surface_with_few_finite_cells_is_nan() -> None:
    assert np.isnan(standardise(np.full((50, 50), np.nan, np.float32))).all()
    assert np.isnan(standardise(np.ones((5, 5), np.float32))).all()
    assert np.isfinite(standardise(np.ones((50, 50), np.float32))).all()  # a flat surface has no peak


@pytest.mark.parametrize("cells", [100, 101, 1234])
def test_quantiles_are_those_of_numpy(cells: int) -> None:
    values = np.random.default_rng(cells).normal(size=cells).astype(np.float32)
    shares = (0.25, 0.5, 0.75, 0.995, 1.0)
    assert _quantiles(values.copy(), shares) == pytest.approx(np.quantile(values, shares).tolist(), abs=1e-6)
