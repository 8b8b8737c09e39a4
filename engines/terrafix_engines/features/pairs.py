"""Interface of image pair matchers: two images in, corresponding points out."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafix_engines.features.keypoints import Detector, PairMatcher


@dataclass(frozen=True)
class PixelPairs:
    """``first_px``, ``second_px`` (N, 2) float32, 0 is the centre of the first pixel; ``confidence`` (N,), 0 to 1."""

    first_px: np.ndarray
    second_px: np.ndarray
    confidence: np.ndarray


class ImagePairMatcher(Protocol):
    name: str

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        """Two images (H, W, 3) uint8 BGR of similar rotation and scale. Raises ModelRunError."""
        ...


class SparsePairMatcher:
    """Detects keypoints in both images and matches them."""

    def __init__(self, detector: Detector, matcher: PairMatcher, max_points: int) -> None:
        """``most``: keypoints per image."""
        self.name = f"{detector.name}, {matcher.name}"
        self._detector, self._matcher, self._max_points = detector, matcher, max_points

    def match(self, first: np.ndarray, second: np.ndarray) -> PixelPairs:
        one, two = self._detector.detect(first, self._max_points), self._detector.detect(second, self._max_points)
        pairs, confidence = self._matcher.match(one, two)
        return PixelPairs(one.xy_px[pairs[:, 0]], two.xy_px[pairs[:, 1]], confidence)
