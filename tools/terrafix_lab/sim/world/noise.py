"""Noise of two kinds: periodic tiles, and unbounded fields that are a function of position and seed."""

import math

import cv2
import numpy as np

LATTICE_SIGMA = 1.5  # lattice points per standard deviation of a smooth field
BORDER = 9  # lattice points around a window that smoothing and interpolation need


def periodic_noise(rng: np.random.Generator, size: int, sigma_px: float) -> np.ndarray:
    """Returns smooth periodic noise: (size, size) float32, zero mean, unit deviation."""
    frequency = np.fft.fftfreq(size)
    gauss = np.exp(-2.0 * (math.pi * sigma_px * frequency) ** 2)
    spectrum = np.fft.rfft2(rng.normal(size=(size, size))) * gauss[:, None] * gauss[None, : size // 2 + 1]
    out = np.fft.irfft2(spectrum, s=(size, size)).astype(np.float32)
    return (out - out.mean()) / out.std()


def white(seed: int, column: int, row: int, width: int, height: int) -> np.ndarray:
    """Returns a window of an unbounded field of independent uniform values: (height, width) float32, zero mean, unit
    deviation.

    Integer hash of the position: "lowbias32" of C. Wellons (public domain).
    """
    x = np.arange(column, column + width).astype(np.uint32) * np.uint32(0x9E3779B1)
    y = (np.arange(row, row + height).astype(np.uint32) ^ np.uint32(seed & 0xFFFFFFFF)) * np.uint32(0x85EBCA77)
    hashed = _hash(y ^ np.uint32((seed >> 16) & 0xFFFFFFFF))[:, None] + x[None, :]
    return (_hash(hashed).astype(np.float32) - np.float32(2**31)) * np.float32(math.sqrt(12.0) / 2**32)


def _hash(h: np.ndarray) -> np.ndarray:
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B)
    return h ^ (h >> np.uint32(16))


def smooth(seed: int, sigma_px: float, column: int, row: int, width: int, height: int) -> np.ndarray:
    """Returns a window of an unbounded smooth field: (height, width) float32, zero mean, unit deviation.

    White noise on a lattice is smoothed and then interpolated; it is smooth enough that interpolation leaves no trace
    of the lattice, which would be a periodic pattern.
    """
    spacing_px = max(sigma_px / LATTICE_SIGMA, 1.0)
    sigma = sigma_px / spacing_px
    i, j = math.floor(column / spacing_px) - BORDER, math.floor(row / spacing_px) - BORDER
    columns, rows = math.ceil(width / spacing_px) + 2 * BORDER + 2, math.ceil(height / spacing_px) + 2 * BORDER + 2
    unit = 2.0 * math.sqrt(math.pi) * sigma  # smoothing divides the standard deviation of white noise by this
    lattice = cv2.GaussianBlur(white(seed, i, j, columns, rows), (0, 0), sigma) * np.float32(unit)
    if spacing_px == 1.0:
        return np.ascontiguousarray(lattice[BORDER : BORDER + height, BORDER : BORDER + width])
    to_lattice = np.array([[1 / spacing_px, 0.0, column / spacing_px - i], [0.0, 1 / spacing_px, row / spacing_px - j]])
    return cv2.warpAffine(lattice, to_lattice, (width, height), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
