"""Keyframes of all fragments, found again by the words of their images (bag of words: Sivic and Zisserman, "Video
Google", ICCV 2003; DBoW2 of ORB-SLAM).

The words are SIFT descriptors of the first keyframes of the flight, so that there is no vocabulary to train or to
deliver. The memory is reserved at the start and never grows: where ground was seen most often, keyframes are removed,
the oldest first, but no fragment as a whole."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from terrafix.vision.covisibility import COARSE_FEATURES
from terrafix.vision.features import Features

MAX_DATABASE_KEYFRAMES = 512  # 22 MiB; 18 km of new ground at 90 m above it [measured: docs/decisions/048]
WORDS = 512
VOCABULARY_KEYFRAMES = 8  # from whose descriptors the words are taken; before that all keyframes are candidates
DESCRIPTOR_SIZE = 128  # [spec: SIFT]


@dataclass(frozen=True)
class StoredKeyframe:
    """``features`` of the frame, with descriptors as uint8 (SIFT's are whole numbers up to 255), and its ``histogram``
    (WORDS,) of words, unit sum: both are valid until the keyframe is removed. ``path``: way to it within its fragment,
    in image widths over the ground."""

    frame_id: int
    fragment_id: int
    path: float
    features: Features
    histogram: np.ndarray


class _Places:
    """Memory of ``count`` keyframes, all of it written once, so that the kernel gives it now and not in the flight.
    Arrays of one keyframe each, between those of single frames in the heap, would keep the heap from being used again
    where they are."""

    def __init__(self, count: int) -> None:
        self._xy_px = np.full((count, COARSE_FEATURES, 2), 0.0, np.float32)
        self._descriptors = np.full((count, COARSE_FEATURES, DESCRIPTOR_SIZE), 0, np.uint8)
        self._size_px = np.full((count, COARSE_FEATURES), 0.0, np.float32)
        self._histograms = np.full((count, WORDS), 0.0, np.float32)
        self._free = list(range(count))
        self._of: dict[int, int] = {}  # frame -> its place

    @property
    def size_bytes(self) -> int:
        return sum(a.nbytes for a in (self._xy_px, self._descriptors, self._size_px, self._histograms))

    def put(self, frame_id: int, features: Features) -> tuple[Features, np.ndarray]:
        """-> the features as they are stored, the strongest COARSE_FEATURES, and a histogram of zeros. A place must be
        free."""
        place = self._of[frame_id] = self._free.pop()
        count = min(len(features), COARSE_FEATURES)
        stored = Features(self._xy_px[place, :count], self._descriptors[place, :count], self._size_px[place, :count])
        stored.xy_px[:] = features.xy_px[:count]
        stored.descriptors[:] = features.descriptors[:count]
        stored.size_px[:] = features.size_px[:count]
        self._histograms[place] = 0.0
        return stored, self._histograms[place]

    def remove(self, frame_id: int) -> None:
        self._free.append(self._of.pop(frame_id))


class KeyframeDatabase:
    """``add`` keyframes in order of time; ``candidates`` for an image."""

    def __init__(self, max_keyframes: int = MAX_DATABASE_KEYFRAMES) -> None:
        self._max_keyframes = max_keyframes
        self._places = _Places(max_keyframes + 1)  # the newest is in before one is removed, which may be itself
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
        """Of all places, those that are free among them."""
        return self._places.size_bytes

    def add(self, frame_id: int, fragment_id: int, path: float, features: Features) -> None:
        """``path``: as in StoredKeyframe; ``features`` with float descriptors, the strongest first."""
        stored, histogram = self._places.put(frame_id, features)
        if self._words is not None:
            histogram[:] = _histogram(stored, self._words)
        self._keyframes[frame_id] = StoredKeyframe(frame_id, fragment_id, path, stored, histogram)
        if self._words is None and len(self._keyframes) == VOCABULARY_KEYFRAMES:
            self._choose_words()
        if len(self._keyframes) > self._max_keyframes:
            removed = self._most_redundant()
            del self._keyframes[removed]
            self._places.remove(removed)

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
