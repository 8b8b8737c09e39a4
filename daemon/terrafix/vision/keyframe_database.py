"""Keyframes of all fragments, found again by the words of their images (bag of words: Sivic and Zisserman, "Video
Google", ICCV 2003; DBoW2 of ORB-SLAM).

The words are SIFT descriptors of the first keyframes of the flight, so that there is no vocabulary to train or to
deliver. The memory is bounded: where ground was seen most often, keyframes are removed, the oldest first, but no
fragment as a whole."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from terrafix.vision.features import Features

MAX_BYTES = 64 * 2**20  # of descriptors, points and rays: 1400 keyframes, 50 km at 90 m above the ground
WORDS = 512
VOCABULARY_KEYFRAMES = 8  # from whose descriptors the words are taken; before that all keyframes are candidates


@dataclass(frozen=True)
class StoredKeyframe:
    """``features`` of the frame, with descriptors as uint8 (SIFT's are whole numbers up to 255), and their rays (N, 2),
    normalised. ``path``: way to it within its fragment, in image widths over the ground."""

    frame_id: int
    fragment_id: int
    path: float
    features: Features
    rays: np.ndarray
    histogram: np.ndarray = field(default_factory=lambda: np.zeros(WORDS, np.float32))  # of words, unit sum

    @property
    def size_bytes(self) -> int:
        features = self.features
        arrays = (features.xy_px, features.descriptors, features.angle_rad, features.size_px, self.rays, self.histogram)
        return sum(a.nbytes for a in arrays)


class KeyframeDatabase:
    """``add`` keyframes in order of time; ``candidates`` for an image. ``max_bytes``: of all keyframes together."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._size_bytes = 0
        self._words: np.ndarray | None = None  # (WORDS, C)
        self._keyframes: dict[int, StoredKeyframe] = {}  # by frame id, oldest first

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def keyframes(self) -> tuple[StoredKeyframe, ...]:
        """Oldest first."""
        return tuple(self._keyframes.values())

    @property
    def size_bytes(self) -> int:
        return self._size_bytes

    def add(self, frame_id: int, fragment_id: int, path: float, features: Features, rays: np.ndarray) -> None:
        """``path``, ``rays``: as in StoredKeyframe; ``features`` with float descriptors."""
        packed = Features(features.xy_px, features.descriptors.astype(np.uint8), features.angle_rad, features.size_px)
        histogram = np.zeros(WORDS, np.float32) if self._words is None else _histogram(features, self._words)
        keyframe = StoredKeyframe(frame_id, fragment_id, path, packed, rays, histogram)
        self._keyframes[frame_id] = keyframe
        self._size_bytes += keyframe.size_bytes
        if self._words is None and len(self._keyframes) == VOCABULARY_KEYFRAMES:
            self._choose_words()
        while self._size_bytes > self._max_bytes and len(self._keyframes) > 1:
            self._size_bytes -= self._keyframes.pop(self._most_redundant()).size_bytes

    def candidates(
        self, features: Features, is_recent: Callable[[StoredKeyframe], bool], count: int
    ) -> list[StoredKeyframe]:
        """The keyframes that share most words with an image of ``features``, the most similar first, without those that
        are ``is_recent``."""
        others = [k for k in self._keyframes.values() if not is_recent(k)]
        if self._words is None or not others:
            return others[:count]
        histograms = np.stack([k.histogram for k in others])
        # Words that many keyframes have say little (inverse document frequency).
        weights = np.log(len(others) / np.maximum(np.count_nonzero(histograms, axis=0), 1)) + 1e-3
        seen = _histogram(features, self._words) * weights
        lengths = np.linalg.norm(histograms * weights, axis=1)
        scores = (histograms * weights) @ seen / np.maximum(lengths, 1e-9)
        return [others[i] for i in np.argsort(-scores, kind="stable")[:count]]

    def has_fragment(self, fragment_id: int) -> bool:
        return any(k.fragment_id == fragment_id for k in self._keyframes.values())

    def _choose_words(self) -> None:
        descriptors = np.vstack([k.features.descriptors for k in self._keyframes.values()]).astype(np.float32)
        if len(descriptors) == 0:
            return
        self._words = descriptors[np.linspace(0, len(descriptors) - 1, WORDS).astype(int)]
        for keyframe in self._keyframes.values():
            keyframe.histogram[:] = _histogram(keyframe.features, self._words)

    def _most_redundant(self) -> int:
        """The keyframe without which the way from the one before to the one after is the shortest; the oldest of
        several. The first and the last keyframe of a fragment are the last to go, and one of each fragment stays, as
        long as there is any other."""
        count = Counter(k.fragment_id for k in self._keyframes.values())
        best: tuple[float, int] | None = None
        ways = self._ways()
        for frame_id, keyframe in self._keyframes.items():
            way = ways[frame_id] if count[keyframe.fragment_id] > 1 else np.inf
            if best is None or way < best[0]:
                best = way, frame_id
        assert best is not None
        return best[1]

    def _ways(self) -> dict[int, float]:
        """Way between the neighbours of each keyframe in its fragment; large at both ends of the fragment."""
        parts: dict[int, list[StoredKeyframe]] = {}
        for keyframe in self._keyframes.values():
            parts.setdefault(keyframe.fragment_id, []).append(keyframe)
        ways = {}
        for part in parts.values():
            for i, keyframe in enumerate(part):
                inside = 0 < i < len(part) - 1
                ways[keyframe.frame_id] = part[i + 1].path - part[i - 1].path if inside else 1e6
        return ways


def _histogram(features: Features, words: np.ndarray) -> np.ndarray:
    """(WORDS,) float32: share of the features that are nearest to each word."""
    descriptors = features.descriptors.astype(np.float32)
    if len(descriptors) == 0:
        return np.zeros(WORDS, np.float32)
    distance2 = np.square(words).sum(axis=1) - 2.0 * descriptors @ words.T  # less a constant of each descriptor
    counts = np.bincount(np.argmin(distance2, axis=1), minlength=WORDS)
    return (counts / len(descriptors)).astype(np.float32)
