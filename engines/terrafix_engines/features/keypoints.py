"""Keypoints with descriptors, and how those of two pictures are joined: the contract of sparse features."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

# Cosine of the angle between descriptors below which a mutual nearest neighbour is chance; the value of XFeat's authors
# for their matcher (accelerated_features, min_cossim).
MIN_SIMILARITY = 0.82


@dataclass(frozen=True)
class Keypoints:
    """``xy_px`` (N, 2) float32, the middle of the first pixel is 0; ``scores`` (N,); ``descriptors`` (N, C) float32,
    unit vectors; ``size_px`` of the picture, width and height."""

    xy_px: np.ndarray
    scores: np.ndarray
    descriptors: np.ndarray
    size_px: tuple[int, int]


class Detector(Protocol):
    name: str

    def detect(self, image: np.ndarray, most: int) -> Keypoints:
        """(H, W, 3) uint8 BGR -> the best points, at most so many. Raises ModelRunError."""
        ...


class PairMatcher(Protocol):
    name: str

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        """-> (M, 2) int64: point of the first and of the second picture; (M,) float32: confidence, 0 to 1. Raises
        ModelRunError."""
        ...


class MutualNearest:
    """Each is the other's most similar one. No weights, and no idea of geometry."""

    name = "mutual nearest"

    def match(self, first: Keypoints, second: Keypoints) -> tuple[np.ndarray, np.ndarray]:
        if len(first.descriptors) == 0 or len(second.descriptors) == 0:
            return np.zeros((0, 2), np.int64), np.zeros(0, np.float32)
        similarity = first.descriptors @ second.descriptors.T
        there, back = similarity.argmax(1), similarity.argmax(0)
        own = np.arange(len(there))
        best = similarity[own, there]
        mutual = (back[there] == own) & (best >= MIN_SIMILARITY)
        return np.column_stack([own[mutual], there[mutual]]), best[mutual].astype(np.float32)


def unit(descriptors: np.ndarray) -> np.ndarray:
    """(N, C) -> the same directions, float32."""
    norm = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.asarray(descriptors / np.maximum(norm, 1e-6), dtype=np.float32)


def best_of(xy_px: np.ndarray, scores: np.ndarray, size_px: tuple[int, int], most: int) -> np.ndarray:
    """Indices of the highest scores within the picture, best first; where they are equal, in the given order."""
    inside = np.flatnonzero((xy_px >= 0).all(1) & (xy_px[:, 0] <= size_px[0] - 1) & (xy_px[:, 1] <= size_px[1] - 1))
    return inside[np.argsort(-scores[inside], kind="stable")[:most]]
