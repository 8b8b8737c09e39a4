"""Zero-mean normalised cross-correlation of dense descriptors by FFT; the result is the whole surface."""

import functools
from collections.abc import Sequence

import cv2
import numpy as np

from terrafix.anchor.matching.fft import cross_correlation, inverse, spectra, template_spectra, transform_shape
from terrafix.anchor.matching.interpolation import interpolated
from terrafix_engines.correlation import GraphCorrelator

MIN_OVERLAP = 0.8  # share of the template that must lie on valid map data; with less, the cell is NaN [tuned]
# lower bound of the map's variance as a share of the template's, so that water and fields without texture are not
# amplified [tuned]
FLAT_VARIANCE = 0.05

# upper quantile of the surface, and the same quantile of a standard normal variable [spec: normal quantile]
TAIL, TAIL_SIGMAS = 0.995, 2.576


class CorrelationWindow:
    """A map window with its transforms, shared by all templates that are correlated with it."""

    def __init__(
        self, descriptors: np.ndarray, valid: np.ndarray, drawn: bool = False, correlator: GraphCorrelator | None = None
    ) -> None:
        """``descriptors`` (C, H, W) float32, ``valid`` (H, W) bool. ``drawn``: the map is drawn from features; where it
        shows nothing the ground is not even, it is not mapped. ``correlator``: on a GPU, instead of OpenCV's
        transforms; local sums, whose differences need single precision, stay there."""
        self._drawn = drawn
        self._correlator = correlator
        self._descriptors = descriptors
        self._shape = descriptors.shape[1:]
        self._local = _LocalSums(descriptors, None if valid.all() else valid)

    def correlate(self, template: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """``template`` (C, h, w), ``mask`` (h, w) bool -> correlation (H - h + 1, W - w + 1) in [-1, 1]. Cell (r, c):
        the template's corner is at the window's cell (r, c). NaN where the map does not cover the template, -inf where
        a drawn map shows nothing below it."""
        return self.correlate_all([(template, mask)])[0]

    def correlate_all(self, templates: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
        """``correlate`` of each (template, mask), by one inference if there is a correlator."""
        weights = [mask.astype(np.float32) for _, mask in templates]
        centred = [_centred(template, mask) for template, mask in templates]
        products = self._correlator.correlate(self._descriptors, centred) if self._correlator else None
        if products is None:
            products = [self._product(one) for one in centred]
        return [self._normalised(*one) for one in zip(products, centred, weights, strict=True)]

    def _product(self, centred: np.ndarray) -> np.ndarray:
        (height, width), (h, w) = self._shape, centred.shape[1:]
        surface = cross_correlation(self._channels, template_spectra(centred, self._fft_shape))
        return surface[: height - h + 1, : width - w + 1]

    @functools.cached_property
    def _fft_shape(self) -> tuple[int, int]:
        return transform_shape(*self._shape)

    @functools.cached_property
    def _channels(self) -> np.ndarray:
        return spectra(self._descriptors, self._fft_shape)

    def _normalised(self, surface: np.ndarray, centred: np.ndarray, weight: np.ndarray) -> np.ndarray:
        template_energy = float(np.vdot(centred, centred))
        variance, overlap = self._local.under(weight, *surface.shape)
        is_flat = variance < FLAT_VARIANCE * template_energy if self._drawn else None
        # in place: each pass over a surface costs as much as a transform of a patch
        np.maximum(variance, FLAT_VARIANCE * template_energy, out=variance)
        variance *= template_energy
        np.maximum(variance, 1e-12, out=variance)
        result = np.divide(surface, np.sqrt(variance, out=variance), out=variance)
        if is_flat is not None:
            result[is_flat] = -np.inf
        if overlap is not None:
            result[overlap < MIN_OVERLAP] = np.nan
        return result


def _centred(template: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """``template`` (C, h, w) float32 less its mean of each channel where ``mask`` (h, w) bool is set, zero
    elsewhere."""
    centred, inside = np.zeros_like(template), mask.view(np.uint8)
    for channel, out in zip(template, centred, strict=True):
        np.subtract(channel, np.float32(cv2.mean(channel, inside)[0]), out=out, where=mask)
    return centred


class _LocalSums:
    """Variance and overlap of the map under a template, for every place of it.

    They change little from cell to cell, because a template has hundreds of cells: computed for every second row and
    column, on means of 2 x 2 cells, and interpolated."""

    def __init__(self, descriptors: np.ndarray, valid: np.ndarray | None) -> None:
        """``descriptors`` (C, H, W) float32; ``valid`` (H, W) bool, None: everywhere."""
        others = [np.einsum("khw,khw->hw", descriptors, descriptors)]
        self._is_valid_everywhere = valid is None
        if valid is not None:
            others.append(valid.astype(np.float32))
        halved = [np.stack([_halved(layer, cv2.BORDER_REPLICATE) for layer in part]) for part in (descriptors, others)]
        self._fft_shape = transform_shape(*halved[0].shape[1:])
        self._channels, self._others = (spectra(part, self._fft_shape) for part in halved)

    def under(self, weight: np.ndarray, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray | None]:
        """``weight`` (h, w) float32, 1 inside of the template, else 0 -> (rows, columns): sum over the channels of the
        squared deviations from their mean; share of the template on valid map data, None: 1 everywhere."""
        (mask,) = template_spectra(_halved(weight, cv2.BORDER_CONSTANT)[None], self._fft_shape)
        product = np.empty_like(mask)
        # the cells between which ``interpolated`` takes values
        used = (slice(0, (rows - 1) // 2 + 2), slice(0, (columns - 1) // 2 + 2))
        squares: np.ndarray | None = None
        for pair in self._channels:
            sums = inverse(np.multiply(pair, mask, out=product))[used]
            squares = cv2.accumulateSquare(sums, np.zeros(sums.shape, np.float32) if squares is None else squares)
        assert squares is not None
        energy = inverse(np.multiply(self._others[0], mask, out=product))[used]
        # a sum of products of means is a quarter of the sum of products
        count = 0.25 * float(weight.sum())
        variance = energy[..., 0] - (squares[..., 0] + squares[..., 1]) / count
        overlap = None if self._is_valid_everywhere else interpolated(energy[..., 1] / count, 2, rows, columns)
        return interpolated(4.0 * variance, 2, rows, columns), overlap


def _halved(layer: np.ndarray, border: int) -> np.ndarray:
    """(H, W) -> means of 2 x 2 cells ((H + 1) // 2, (W + 1) // 2)."""
    height, width = layer.shape
    even = cv2.copyMakeBorder(layer, 0, height % 2, 0, width % 2, border) if height % 2 or width % 2 else layer
    return np.asarray(cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA))


def standardise(surface: np.ndarray) -> np.ndarray:
    """Surface minus its median, in robust standard deviations: random alignment gives 0 +- 1. NaN if fewer than 100
    cells are finite.

    Streets and crop rows correlate with many wrong places, so the spread is the larger of the interquartile estimate
    and the upper-tail estimate. The peak has too few cells to influence it.
    """
    finite = surface[np.isfinite(surface)]
    if finite.size < 100:
        return np.full_like(surface, np.nan)
    low, median, high, tail = _quantiles(finite, (0.25, 0.5, 0.75, TAIL))
    spread = max((high - low) / 1.349, (tail - median) / TAIL_SIGMAS)
    standardised = surface - np.float32(median)
    standardised /= np.float32(max(spread, 1e-4))
    return np.asarray(standardised)


def _quantiles(values: np.ndarray, shares: tuple[float, ...]) -> list[float]:
    """Quantiles of ``values`` (N,), which are reordered; linear between two values. np.quantile imports numpy.ma at its
    first call, which takes as long as the frame."""
    places = [divmod(share * (values.size - 1), 1.0) for share in shares]
    wanted = {min(int(below) + k, values.size - 1) for below, _ in places for k in (0, 1)}
    values.partition(sorted(wanted))
    found = []
    for below, part in places:
        lower, upper = float(values[int(below)]), float(values[min(int(below) + 1, values.size - 1)])
        found.append(lower + part * (upper - lower))
    return found
