"""Detects images that repeat an earlier one: a frozen sensor, or a driver that cycles through old buffers.

A camera in flight does not show exactly the same view twice: attitude and position vary by more than a hundredth of a
degree. A frozen sensor adds new noise to every buffer, so pixel equality is not a test. The displacement between two
images is one, because noise averages out of it."""

from collections import deque
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

HISTORY = 40  # images; buffer rings of drivers and encoders have 3 to 32
WIDTH_PX = 360  # of the compared copies: each pixel averages four or more sensor pixels, which reduces noise
THUMBNAIL_PX = 24  # side of the thumbnails that select the earlier image to compare with
# Two images with a displacement below this in every quadrant are the same view. For a 90 degree lens over 360 px it is
# 0.006 degrees; attitude control of multirotors, gimbals included, holds 0.01 to 0.02 (manufacturers' data sheets).
MAX_SHIFT_PX = 0.025
# unrelated images also have a displacement estimate near zero, but a correlation below 0.3
MIN_PICTURE_CORRELATION = 0.5
MIN_GRADIENT = 0.5  # RMS, grey levels per pixel: a uniform image has no measurable displacement


class Repeat(Enum):
    """The earlier image that an image repeats."""

    NONE = "none"
    IDENTICAL = "identical"  # the previous image, equal in every pixel; no sensor delivers that
    PREVIOUS = "previous"  # the previous image except for noise: a stationary camera, or a frozen sensor
    OLDER = "older"  # an image before the previous one: a stale buffer


@dataclass(frozen=True)
class _Copy:
    image: np.ndarray  # (H, W) uint8
    thumbnail: np.ndarray  # (THUMBNAIL_PX, THUMBNAIL_PX) float32, zero mean


class PictureHistory:
    """The newest ``HISTORY`` images, compared by their content."""

    def __init__(self) -> None:
        self._copies: deque[_Copy] = deque(maxlen=HISTORY)
        self._last: np.ndarray | None = None

    def classify(self, gray: np.ndarray) -> Repeat:
        """Adds the newest image, ``gray`` (H, W) uint8. -> which earlier image it repeats."""
        height = max(round(gray.shape[0] * WIDTH_PX / gray.shape[1]), 8)
        image = cv2.resize(gray, (WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        small = cv2.resize(image, (THUMBNAIL_PX, THUMBNAIL_PX), interpolation=cv2.INTER_AREA).astype(np.float32)
        copy = _Copy(image, small - small.mean())
        earlier, last = list(self._copies), self._last
        self._copies.append(copy)
        self._last = gray
        if last is None:
            return Repeat.NONE
        if np.array_equal(last, gray):
            return Repeat.IDENTICAL
        if same_view(earlier[-1].image, image):
            return Repeat.PREVIOUS
        older = earlier[:-1]
        if not older:
            return Repeat.NONE
        nearest = min(older, key=lambda other: float(np.square(other.thumbnail - copy.thumbnail).sum()))
        return Repeat.OLDER if same_view(nearest.image, image) else Repeat.NONE


def same_view(before: np.ndarray, now: np.ndarray) -> bool:
    """True when two images (H, W) uint8 of equal size show the same view except for noise.

    One Lucas-Kanade step (1981) per quadrant: the least-squares displacement."""
    if before.shape != now.shape:
        return False
    first, second = before.astype(np.float32), now.astype(np.float32)
    if _correlation(first, second) < MIN_PICTURE_CORRELATION:
        return False
    along_x, along_y = (
        cv2.Scharr(first, cv2.CV_32F, 1, 0, scale=1 / 32),
        cv2.Scharr(first, cv2.CV_32F, 0, 1, scale=1 / 32),
    )
    difference = second - first
    h, w = first.shape[0] // 2, first.shape[1] // 2
    for rows in (slice(0, h), slice(h, 2 * h)):
        for columns in (slice(0, w), slice(w, 2 * w)):
            gradient = np.stack([along_x[rows, columns].ravel(), along_y[rows, columns].ravel()])
            normal, right = normal_equations(gradient, difference[rows, columns].ravel())
            if np.linalg.eigvalsh(normal)[0] < MIN_GRADIENT**2 * gradient.shape[1]:
                return False
            moved_px = np.linalg.solve(normal, right)
            if float(np.hypot(*moved_px)) > MAX_SHIFT_PX:
                return False
    return True


def normal_equations(gradient: np.ndarray, difference: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``gradient`` (2, N) float32, multiples of 1/32 up to 255; ``difference`` (N,) float32, whole numbers up to 255.
    -> matrix (2, 2) and right side (2,), float64, of the displacement.

    No matrix product of the linear algebra library, whose kernels round differently and, with SVE, set flags of
    floating-point errors: each product fits in the 24 bits of a float32, and each sum of them in the 53 of a float64,
    so the result is exact on every processor."""
    x, y = gradient
    xx, xy, yy, xd, yd = (
        np.sum(a * b, dtype=np.float64) for a, b in ((x, x), (x, y), (y, y), (x, difference), (y, difference))
    )
    return np.array([[xx, xy], [xy, yy]]), np.array([xd, yd])


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-9))
