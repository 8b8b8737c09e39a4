"""Zero-mean normalised cross-correlation of dense descriptors by FFT; the result is the whole surface."""

import numpy as np

from terrafix.anchor.matching.fft import spectra, transform_shape

MIN_OVERLAP = 0.8  # share of the template that must lie on valid map data; with less, the cell is NaN [tuned]
# lower bound of the map's variance as a share of the template's, so that water and fields without texture are not
# amplified [tuned]
FLAT_VARIANCE = 0.05

# upper quantile of the surface, and the same quantile of a standard normal variable [spec: normal quantile]
TAIL, TAIL_SIGMAS = 0.995, 2.576


class CorrelationWindow:
    """A map window with its transforms, shared by all templates that are correlated with it."""

    def __init__(self, descriptors: np.ndarray, valid: np.ndarray, drawn: bool = False) -> None:
        """``descriptors`` (C, H, W) float32, ``valid`` (H, W) bool. ``drawn``: the map is drawn from features; where it
        shows nothing the ground is not even, it is not mapped."""
        self._drawn = drawn
        self._shape = descriptors.shape[1:]
        self._fft_shape = transform_shape(*self._shape)
        self._channels = spectra(descriptors, self._fft_shape)
        self._energy = spectra(np.einsum("khw,khw->hw", descriptors, descriptors), self._fft_shape)
        self._valid = None if valid.all() else spectra(valid.astype(np.float32), self._fft_shape)

    def correlate(self, template: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """``template`` (C, h, w), ``mask`` (h, w) bool -> correlation (H - h + 1, W - w + 1) in [-1, 1]. Cell (r, c):
        the template's corner is at the window's cell (r, c). NaN where the map does not cover the template, -inf where
        a drawn map shows nothing below it."""
        (height, width), (h, w) = self._shape, mask.shape
        weight = mask.astype(np.float32)
        count = float(weight.sum())
        centred = (template - ((template * weight).sum((1, 2)) / count)[:, None, None]) * weight
        template_energy = float((centred**2).sum())
        rows, columns = height - h + 1, width - w + 1
        m = spectra(weight, self._fft_shape).conj()

        def inverse(spectrum: np.ndarray) -> np.ndarray:
            return np.fft.irfft2(spectrum, self._fft_shape)[..., :rows, :columns]

        product = inverse((self._channels * spectra(centred, self._fft_shape).conj()).sum(0))
        sums = inverse(self._channels * m)
        variance = inverse(self._energy * m) - (sums**2).sum(0) / count
        surface = product / np.sqrt(
            np.maximum(np.maximum(variance, FLAT_VARIANCE * template_energy) * template_energy, 1e-12)
        )
        if self._drawn:
            surface[variance < FLAT_VARIANCE * template_energy] = -np.inf
        if self._valid is not None:
            surface[inverse(self._valid * m) < MIN_OVERLAP * count] = np.nan
        return surface.astype(np.float32)


def standardise(surface: np.ndarray) -> np.ndarray:
    """Surface minus its median, in robust standard deviations: random alignment gives 0 +- 1. NaN if fewer than 100
    cells are finite.

    Streets and crop rows correlate with many wrong places, so the spread is the larger of the interquartile estimate
    and the upper-tail estimate. The peak has too few cells to influence it.
    """
    finite = surface[np.isfinite(surface)]
    if finite.size < 100:
        return np.full_like(surface, np.nan)
    low, median, high, tail = np.quantile(finite, (0.25, 0.5, 0.75, TAIL))
    spread = max((high - low) / 1.349, (tail - median) / TAIL_SIGMAS)
    return (surface - median) / max(float(spread), 1e-4)
