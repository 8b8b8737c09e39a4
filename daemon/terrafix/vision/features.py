"""Features of an image and their matches, for frames that KLT does not track: SIFT."""

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

SIFT_FEATURES = 1500
SIFT_RATIO = 0.8  # ratio test, Lowe 2004
# diameter of the smallest feature that SIFT finds [spec: sigma of 1.6 px in an image of twice the size]
MIN_SIZE_PX = 1.8

NO_POINTS = np.zeros((0, 2), np.float32)


@dataclass(frozen=True)
class Features:
    """``xy_px`` (N, 2) float32, ``descriptors`` (N, C) float32, ``size_px`` (N,). The strongest one is first."""

    xy_px: np.ndarray
    descriptors: np.ndarray
    size_px: np.ndarray

    def __len__(self) -> int:
        return len(self.xy_px)

    def scaled(self, factor: float) -> "Features":
        """In pixels of the image resized by ``factor``."""
        # Pixel indices denote centres, as in CameraCalibration.scaled.
        xy_px = ((self.xy_px + 0.5) * factor - 0.5).astype(np.float32)
        return Features(xy_px, self.descriptors, (self.size_px * factor).astype(np.float32))

    def coarse(self, factor: float, count: int) -> "Features":
        """At most ``count`` of those that are large enough for the image resized by ``factor``, in pixels of that."""
        keep = np.flatnonzero(self.size_px * factor >= MIN_SIZE_PX)[:count]
        return Features(self.xy_px[keep], self.descriptors[keep], self.size_px[keep]).scaled(factor)


@dataclass(frozen=True)
class Matches:
    """``a_px``, ``b_px`` (N, 2): the same points in two images."""

    a_px: np.ndarray
    b_px: np.ndarray

    def __len__(self) -> int:
        return len(self.a_px)


class FeatureMatcher(Protocol):
    def describe(self, gray: np.ndarray) -> Features:
        """(H, W) uint8 -> its features."""

    def match(self, first: Features, second: Features) -> Matches: ...

    def shared(self, first: Features, second: Features) -> int:
        """Number of matches, by the fastest method: which images are worth to be matched."""


class SiftMatcher:
    """SIFT with the ratio test (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004)."""

    def __init__(self, features: int = SIFT_FEATURES) -> None:
        """``features``: most of one image, the strongest ones."""
        self._sift = cv2.SIFT.create(nfeatures=features, enable_precise_upscale=True)

    def describe(self, gray: np.ndarray) -> Features:
        keypoints, descriptors = self._sift.detectAndCompute(gray, None)
        if descriptors is None:
            return Features(NO_POINTS, np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
        order = np.argsort([-k.response for k in keypoints], kind="stable")
        keypoints = [keypoints[i] for i in order]
        xy_px = np.array([k.pt for k in keypoints], np.float32)
        size_px = np.array([k.size for k in keypoints], np.float32)
        return Features(xy_px, descriptors[order], size_px)

    def match(self, first: Features, second: Features) -> Matches:
        """Each feature is in one pair at most: of a photo with little texture, dozens of features are nearest to one
        and the same, and any number of such pairs agrees with a homography that maps the image into that point."""
        a, b = mutual_nearest(first.descriptors, second.descriptors)
        return Matches(first.xy_px[a], second.xy_px[b])

    def shared(self, first: Features, second: Features) -> int:
        return len(mutual_nearest(first.descriptors, second.descriptors)[0])


def mutual_nearest(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the pairs of descriptors (N, C), (M, C) that are nearest to each other, where the second nearest of
    the first set is farther by SIFT_RATIO."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    # Squared distances. SIFT's descriptors are whole numbers up to 255, so that these are exact on every processor.
    distance2 = first @ (-2.0 * second.T)
    distance2 += np.square(first).sum(axis=1)[:, None]
    distance2 += np.square(second).sum(axis=1)
    index, nearest = np.arange(len(first)), distance2.argmin(axis=1)
    best = distance2[index, nearest]
    distance2[index, nearest] = np.inf
    clear = np.flatnonzero(best < SIFT_RATIO**2 * distance2.min(axis=1))
    distance2[index, nearest] = best
    good = distance2[:, nearest[clear]].argmin(axis=0) == clear  # down the columns of these alone
    return clear[good], nearest[clear[good]]
