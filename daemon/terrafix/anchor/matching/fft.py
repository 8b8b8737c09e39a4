"""Cross-correlation of multi-channel images by OpenCV's complex 2-D Fourier transforms.

Two channels are the real and the imaginary part of one complex image: (a + i b) correlated with (c + i d) has the sum
of both correlations, of a with c and of b with d, in its real part. A complex transform costs 0.7 of two real ones, and
a third of NumPy's (90 x 90 cells, 8 channels). Products of spectra are NumPy's, which take a third of the time of
cv2.mulSpectrums (88 x 88 cells, 4 pairs: 16 and 52 us); spectra of templates are conjugate, so that no pass remains for
it."""

import cv2
import numpy as np

# Sides are multiples of it: Intel's transforms take less time for 96 cells than for 90 or 81. [measured: 17, 20, 20 us]
SIDE_MULTIPLE = 8
# Prime factors of a side for which a cell takes no more time. Intel's transforms have 7, 11 and 13, others do not.
# [measured: 88 cells 14 us, 96 cells 17 us, 136 = 8 * 17 cells 107 us]
PRIMES = (2, 3, 5, 7, 11, 13) if cv2.ipp.useIPP() else (2, 3, 5)


def transform_shape(height: int, width: int) -> tuple[int, int]:
    """Small sides >= (height, width) that OpenCV transforms fast."""
    return _side(height), _side(width)


def _side(cells: int) -> int:
    multiple = -(-cells // SIDE_MULTIPLE)
    while not _is_fast(multiple):
        multiple += 1
    return SIDE_MULTIPLE * multiple


def _is_fast(multiple: int) -> bool:
    for prime in PRIMES:
        while multiple % prime == 0:
            multiple //= prime
    return multiple == 1


def pairs(x: np.ndarray, shape: tuple[int, int] | None = None, *, conjugate: bool = False) -> np.ndarray:
    """(C, h, w) -> (ceil(C / 2), H, W, 2) float32: pairs of channels, zero-padded to ``shape`` (H, W). Of an odd number
    the last channel has no other. ``conjugate``: the second channel of each pair is negated."""
    channels, h, w = x.shape
    out = np.empty((-(-channels // 2), *(shape or (h, w)), 2), np.float32)
    out[:, h:], out[:, :h, w:] = 0.0, 0.0
    out[:, :h, :w, 0] = x[::2]
    second = out[: channels // 2, :h, :w, 1]
    if conjugate:
        np.negative(x[1::2], out=second)
    else:
        second[:] = x[1::2]
    if channels % 2:
        out[-1, :h, :w, 1] = 0.0
    return out


def spectra(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(C, h, w) float32 -> (ceil(C / 2), H, W) complex64: spectra of pairs of channels, zero-padded to ``shape`` (H, W)
    from ``transform_shape``."""
    out = pairs(x, shape)
    for pair in out:
        cv2.dft(pair, pair)
    return as_complex(out)


def template_spectra(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """The conjugate of ``spectra``, for the templates of a correlation."""
    out = pairs(x, shape, conjugate=True)
    for pair in out:
        conjugate_spectrum(pair, pair)
    return as_complex(out)


def conjugate_spectrum(pair: np.ndarray, out: np.ndarray) -> None:
    """Conjugate spectrum of a pair (H, W, 2) whose second channel is negated, into ``out``: the inverse transform
    without its scale."""
    cv2.dft(pair, out, flags=cv2.DFT_INVERSE)


def as_complex(pairs_or_spectra: np.ndarray) -> np.ndarray:
    """(..., 2) float32 -> (...) complex64, the same memory."""
    return pairs_or_spectra.view(np.complex64)[..., 0]


def cross_correlation(images: np.ndarray, templates: np.ndarray) -> np.ndarray:
    """``spectra`` of images and ``template_spectra`` with as many channels -> (H, W) float32: the sum over the channels
    of their circular cross-correlations. Cell (r, c): the template's first cell lies at the image's cell (r, c)."""
    total = images[0] * templates[0]
    product = np.empty_like(total)
    for image, template in zip(images[1:], templates[1:], strict=True):
        np.add(total, np.multiply(image, template, out=product), out=total)
    return inverse(total)[..., 0]


def inverse(spectrum: np.ndarray) -> np.ndarray:
    """(H, W) complex64 -> (H, W, 2) float32: the pair of channels. Overwrites ``spectrum``."""
    pair = spectrum.view(np.float32).reshape(*spectrum.shape, 2)
    return np.asarray(cv2.dft(pair, pair, flags=cv2.DFT_INVERSE | cv2.DFT_SCALE))
