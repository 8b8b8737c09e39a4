"""Real 2-D Fourier transforms by OpenCV in the layout of NumPy's ``rfft2``: a quarter of NumPy's cost where OpenCV is
built with Intel's primitives, no slower elsewhere. The inverse transform of the few spectra that remain after
multiplication uses NumPy."""

import cv2
import numpy as np


def transform_shape(height: int, width: int) -> tuple[int, int]:
    """Smallest even sides >= (height, width) that OpenCV transforms fast."""
    return 2 * cv2.getOptimalDFTSize((height + 1) // 2), 2 * cv2.getOptimalDFTSize((width + 1) // 2)


def spectra(x: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(..., h, w) float32 -> (..., H, W // 2 + 1) complex64, zero-padded to ``shape`` (H, W) from ``transform_shape``;
    equals ``np.fft.rfft2(x, shape)``."""
    (h, w), (height, width) = x.shape[-2:], shape
    images = x.reshape(-1, h, w)
    padded = np.zeros(shape, np.float32)
    packed = np.empty((len(images), height, width), np.float32)
    for image, into in zip(images, packed, strict=True):
        padded[:h, :w] = image
        cv2.dft(padded, into)  # without nonzeroRows, which disables the fast path
    out = np.empty((len(images), height, width // 2 + 1), np.complex64)
    # OpenCV's packed layout, see the documentation of `dft`: columns 1 to W / 2 - 1 hold real and imaginary parts side
    # by side. Column 0, and column W / 2 in the last one, are spectra of real sequences; half of each is omitted.
    out[:, :, 1:-1] = packed[:, :, 1:-1].view(np.complex64)
    middle = height // 2
    for column in (0, -1):
        real = np.ascontiguousarray(packed[:, :, column])
        half = real[:, 1:-1].view(np.complex64)
        out[:, 0, column], out[:, middle, column] = real[:, 0], real[:, -1]
        out[:, 1:middle, column], out[:, middle + 1 :, column] = half, half[:, ::-1].conj()
    return out.reshape(*x.shape[:-2], height, width // 2 + 1)
