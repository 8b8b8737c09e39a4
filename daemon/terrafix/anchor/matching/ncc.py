"""Zero-mean normalised cross-correlation of dense descriptors by FFT: the whole surface, not its peak."""

import numpy as np

from terrafix.anchor.matching.fft import spectra, transform_shape

MIN_OVERLAP = 0.8  # of the template over valid map; less says nothing about a place
FLAT_VARIANCE = 0.05  # of the texture that the template has: water and fields without texture must not be amplified

TAIL, TAIL_SIGMAS = 0.995, 2.576  # upper quantile of the surface and what it is for a normal variable


class Searchable:
    """A map window whose transforms are shared by all templates that are searched in it."""

    def __init__(self, descriptors: np.ndarray, valid: np.ndarray) -> None:
        """``descriptors`` (C, H, W) float32, ``valid`` (H, W) bool."""
        self._shape = descriptors.shape[1:]
        self._fft_shape = transform_shape(*self._shape)
        self._channels = spectra(descriptors, self._fft_shape)
        self._energy = spectra(np.einsum("khw,khw->hw", descriptors, descriptors), self._fft_shape)
        self._valid = None if valid.all() else spectra(valid.astype(np.float32), self._fft_shape)

    def search(self, template: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """``template`` (C, h, w), ``mask`` (h, w) bool -> correlation (H - h + 1, W - w + 1) in [-1, 1];
        cell (r, c): the template's corner lies on the window's cell (r, c). NaN where the map does not cover it."""
        (height, width), (h, w) = self._shape, mask.shape
        weight = mask.astype(np.float32)
        count = float(weight.sum())
        centred = (template - ((template * weight).sum((1, 2)) / count)[:, None, None]) * weight
        own = float((centred**2).sum())
        rows, columns = height - h + 1, width - w + 1
        m = spectra(weight, self._fft_shape).conj()

        def back(spectrum: np.ndarray) -> np.ndarray:
            return np.fft.irfft2(spectrum, self._fft_shape)[..., :rows, :columns]

        product = back((self._channels * spectra(centred, self._fft_shape).conj()).sum(0))
        sums = back(self._channels * m)
        variance = back(self._energy * m) - (sums**2).sum(0) / count
        surface = product / np.sqrt(np.maximum(np.maximum(variance, FLAT_VARIANCE * own) * own, 1e-12))
        if self._valid is not None:
            surface[back(self._valid * m) < MIN_OVERLAP * count] = np.nan
        return surface.astype(np.float32)


def standardise(surface: np.ndarray) -> np.ndarray:
    """Surface in robust standard deviations from its median: what chance alignment gives here is 0 +- 1.

    Streets and rows agree with many wrong places, so the spread is that of the bulk or that of the upper tail,
    whichever is wider; the peak itself is too small to count in it."""
    finite = surface[np.isfinite(surface)]
    if finite.size < 100:
        return np.full_like(surface, np.nan)
    low, median, high, tail = np.quantile(finite, (0.25, 0.5, 0.75, TAIL))
    spread = max((high - low) / 1.349, (tail - median) / TAIL_SIGMAS)
    return (surface - median) / max(float(spread), 1e-4)
