"""Fourier transforms of real pictures by OpenCV, as NumPy's ``rfft2`` gives them: at a quarter of the cost where OpenCV
has Intel's primitives, and no dearer elsewhere. The inverse of the few spectra that are left after the product is
NumPy's."""

import cv2
import numpy as np


def transform_shape(height: int, width: int) -> tuple[int, int]:
    """Sides that are quickly transformed, not smaller than these, and even."""
    return 2 * cv2.getOptimalDFTSize((height + 1) // 2), 2 * cv2.getOptimalDFTSize((width + 1) // 2)


def spectra(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(..., h, w) float32 -> (..., H, W // 2 + 1) complex64 with zeros up to ``shape`` (H, W), of ``transform_shape``:
    ``np.fft.rfft2(x, shape)``."""
    (h, w), (height, width) = x.shape[-2:], shape
    pictures = x.reshape(-1, h, w)
    padded = np.zeros(shape, np.float32)
    packed = np.empty((len(pictures), height, width), np.float32)
    for picture, into in zip(pictures, packed, strict=True):
        padded[:h, :w] = picture
        cv2.dft(padded, into)  # without nonzeroRows, which leaves the fast path
    out = np.empty((len(pictures), height, width // 2 + 1), np.complex64)
    # Packed as OpenCV documents for `dft`: of columns 1 to W / 2 - 1 real and imaginary parts side by side; column 0,
    # and W / 2 in the last one, are spectra of real numbers, and half of each is left out.
    out[:, :, 1:-1] = packed[:, :, 1:-1].view(np.complex64)
    middle = height // 2
    for column in (0, -1):
        real = np.ascontiguousarray(packed[:, :, column])
        half = real[:, 1:-1].view(np.complex64)
        out[:, 0, column], out[:, middle, column] = real[:, 0], real[:, -1]
        out[:, 1:middle, column], out[:, middle + 1 :, column] = half, half[:, ::-1].conj()
    return out.reshape(*x.shape[:-2], height, width // 2 + 1)
