"""Pictures that repeat an earlier one: a frozen sensor, a driver that returns old buffers in turn.

A camera in the air never shows exactly the same view twice: attitude and position sway by more than a hundredth of a
degree. Sensor noise is new in every buffer that a frozen sensor delivers, so equality of the pixels does not tell; the
displacement between two pictures does, and noise averages out of it."""

from collections import deque
from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np

HISTORY = 40  # pictures: buffer rings of drivers and encoders have 3 to 32
WIDTH_PX = 360  # of the copies that are compared: four pixels and more of the sensor in each, which damps its noise
THUMBNAIL_PX = 24  # side of the thumbnails that choose which earlier picture is compared
# Displacement up to which two pictures are the same, in every quarter of the picture. Of 90 degrees over 360 px this is
# 0.006 degrees; attitude control of multirotors, gimbals included, holds 0.01 to 0.02 (manufacturers' data sheets).
SAME_PX = 0.025
SAME_CORRELATION = 0.5  # of unrelated pictures the estimated displacement is near zero, too, and this is below 0.3
MIN_GRADIENT = 0.5  # grey values per pixel, root mean square: a black or grey picture shows no displacement


class Repeat(Enum):
    """Which earlier picture a picture repeats."""

    NONE = "none"
    IDENTICAL = "identical"  # the one before, pixel by pixel: no sensor delivers that
    PREVIOUS = "previous"  # the one before, but for noise: a camera that stands still, or a frozen one
    OLDER = "older"  # not the one before: a stale buffer


@dataclass(frozen=True)
class _Copy:
    image: np.ndarray  # (H, W) uint8
    thumbnail: np.ndarray  # (THUMBNAIL_PX, THUMBNAIL_PX) float32, zero mean


class PictureHistory:
    """The newest ``HISTORY`` pictures, compared by what they show."""

    def __init__(self) -> None:
        self._copies: deque[_Copy] = deque(maxlen=HISTORY)
        self._last: np.ndarray | None = None

    def look(self, gray: np.ndarray) -> Repeat:
        """``gray`` (H, W) uint8: the newest picture, which joins the history. -> what it repeats."""
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
    """Whether two pictures (H, W), uint8, of one size show the same view but for noise.

    One step of Lucas and Kanade (1981) in each quarter: the displacement that explains the difference best."""
    if before.shape != now.shape:
        return False
    first, second = before.astype(np.float32), now.astype(np.float32)
    if _correlation(first, second) < SAME_CORRELATION:
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
            normal = gradient @ gradient.T
            if np.linalg.eigvalsh(normal)[0] < MIN_GRADIENT**2 * gradient.shape[1]:
                return False
            moved_px = np.linalg.solve(normal, gradient @ difference[rows, columns].ravel())
            if float(np.hypot(*moved_px)) > SAME_PX:
                return False
    return True


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    a, b = a - a.mean(), b - b.mean()
    return float((a * b).sum() / max(float(np.sqrt((a * a).sum() * (b * b).sum())), 1e-9))
