"""Features of an image and their matches, for frames that KLT does not track: SIFT."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

SIFT_FEATURES = 1500
SIFT_RATIO = 0.8  # ratio test, Lowe 2004

_NO_POINTS, _NO_VALUES = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)


@dataclass(frozen=True)
class Features:
    """``xy_px`` (N, 2) float32, ``descriptors`` (N, C) float32, ``angle_rad`` (N,): orientation in the image, clockwise
    from its x axis; ``size_px`` (N,)."""

    xy_px: np.ndarray
    descriptors: np.ndarray
    angle_rad: np.ndarray
    size_px: np.ndarray


@dataclass(frozen=True)
class Matches:
    """``a_px``, ``b_px`` (N, 2): the same points in two images. ``turn_rad`` (N,): by which each feature is rotated
    from the first image to the second, ``octaves`` (N,): by which it grows, log2."""

    a_px: np.ndarray
    b_px: np.ndarray
    turn_rad: np.ndarray
    octaves: np.ndarray

    def __len__(self) -> int:
        return len(self.a_px)


NO_MATCHES = Matches(_NO_POINTS, _NO_POINTS, _NO_VALUES, _NO_VALUES)


class FeatureMatcher(Protocol):
    def describe(self, gray: np.ndarray) -> Features:
        """(H, W) uint8 -> its features."""
        ...

    def match(self, first: Features, second: Features) -> Matches: ...


class SiftMatcher:
    """SIFT with the ratio test (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004)."""

    def __init__(self, features: int = SIFT_FEATURES) -> None:
        """``features``: most of one image, the strongest ones."""
        self._sift = cv2.SIFT.create(nfeatures=features, enable_precise_upscale=True)

    def describe(self, gray: np.ndarray) -> Features:
        keypoints, descriptors = self._sift.detectAndCompute(gray, None)
        if descriptors is None:
            return Features(_NO_POINTS, np.zeros((0, 128), np.float32), _NO_VALUES, _NO_VALUES)
        xy_px = np.array([k.pt for k in keypoints], np.float32)
        angle_rad = np.radians(np.array([k.angle for k in keypoints], np.float32))
        return Features(xy_px, descriptors, angle_rad, np.array([k.size for k in keypoints], np.float32))

    def match(self, first: Features, second: Features) -> Matches:
        if len(first.xy_px) < 2 or len(second.xy_px) < 2:
            return NO_MATCHES
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < SIFT_RATIO * p[1].distance]
        if not good:
            return NO_MATCHES
        a, b = np.array([m.queryIdx for m in good]), np.array([m.trainIdx for m in good])
        octaves = np.log2(second.size_px[b] / first.size_px[a])
        return Matches(first.xy_px[a], second.xy_px[b], second.angle_rad[b] - first.angle_rad[a], octaves)
