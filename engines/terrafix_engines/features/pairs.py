"""Two pictures in, points that are the same in both out: the one contract of everything that joins pictures."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafix_engines.features.keypoints import Detector, PairMatcher


@dataclass(frozen=True)
class PixelPairs:
    """``first_px``, ``second_px`` (N, 2) float32, the middle of the first pixel is 0; ``confidence`` (N,), 0 to 1."""

    first_px: np.ndarray
    second_px: np.ndarray
    confidence: np.ndarray


class PictureMatcher(Protocol):
    name: str

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        """Two pictures (H, W, 3) uint8 BGR, turned and scaled alike. Raises ModelRunError."""
        ...


class ByPoints:
    """Points of both pictures, joined."""

    def __init__(self, detector: Detector, joiner: PairMatcher, most: int) -> None:
        """``most``: points of each picture."""
        self.name = f"{detector.name}, {joiner.name}"
        self._detector, self._joiner, self._most = detector, joiner, most

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        one, two = self._detector.detect(first, self._most), self._detector.detect(second, self._most)
        pairs, confidence = self._joiner.match(one, two)
        return PixelPairs(one.xy_px[pairs[:, 0]], two.xy_px[pairs[:, 1]], confidence)
