"""Smooth noise without seams."""

import math

import numpy as np


def periodic_noise(rng: np.random.Generator, size: int, sigma_px: float) -> np.ndarray:
    """Smooth noise that repeats without a seam: (size, size) float32, zero mean, unit deviation."""
    frequency = np.fft.fftfreq(size)
    gauss = np.exp(-2.0 * (math.pi * sigma_px * frequency) ** 2)
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * gauss[:, None] * gauss[None, : size // 2 + 1]
    out = np.fft.irfft2(spectrum, s=(size, size)).astype(np.float32)
    return (out - out.mean()) / out.std()
