"""Keypoints with descriptors, and the interfaces of keypoint detectors and matchers."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

# Minimum cosine similarity of a mutual nearest neighbour match; the value of XFeat's authors for their matcher
# (accelerated_features, min_cossim).
MIN_SIMILARITY = 0.82


@dataclass(frozen=True)
class Keypoints:
    """``xy_px`` (N, 2) float32, 0 is the centre of the first pixel; ``scores`` (N,); ``descriptors`` (N, C) float32,
    unit vectors; ``size_px``: width and height of the image."""

    xy_px: np.ndarray
    scores: np.ndarray
    descriptors: np.ndarray
    size_px: tuple[int, int]


class Detector(Protocol):
    name: str

    def detect(self, image: np.ndarray, max_points: int) -> Keypoints:
        """(H, W, 3) uint8 BGR -> the strongest keypoints, at most ``most``. Raises ModelRunError."""
        ...


class PairMatcher(Protocol):
    name: str

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        """-> (M, 2) int64: indices in ``first`` and ``second``; (M,) float32: confidence, 0 to 1. Raises
        ModelRunError."""
        ...


class MutualNearestMatcher:
    """Mutual nearest neighbours in descriptor space, without weights or geometry."""

    name = "mutual nearest"

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        if len(first.descriptors) == 0 or len(second.descriptors) == 0:
            return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
        similarity = first.descriptors @ second.descriptors.T
        second_of_first, first_of_second = similarity.argmax(1), similarity.argmax(0)
        first_index = np.arange(len(second_of_first))
        best = similarity[first_index, second_of_first]
        mutual = (first_of_second[second_of_first] == first_index) & (best >= MIN_SIMILARITY)
        return np.column_stack([first_index[mutual], second_of_first[mutual]]), best[mutual].astype(np.float32)


def unit_rows(descriptors: np.ndarray) -> np.ndarray:
    """(N, C) -> (N, C) float32, rows of unit norm."""
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.maximum(norm, 1e-6), dtype=np.float32)


def select_strongest(xy_px: np.ndarray, scores: np.ndarray, size_px: tuple[int, int], max_points: int) -> np.ndarray:
    """Indices of the ``most`` highest scores inside the image, in descending order; stable for equal scores."""
    inside = np.flatnonzero((xy_px >= 0).all(1) & (xy_px[:, 0] <= size_px[0] - 1) & (xy_px[:, 1] <= size_px[1] - 1))
    return inside[np.argsort(-scores[inside], kind="stable")[:max_points]]
