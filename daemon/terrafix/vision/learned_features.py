"""Keypoints of a learned model instead of SIFT, matched by their descriptors or by a learned matcher.

Their descriptors are not rotation-invariant: an image is described in four rotations, and two images are matched in the
relative rotation with most matches."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.vision.features import Features, Matches
from terrafix_engines.features.keypoints import Detector, Keypoints, MutualNearestMatcher, PairMatcher

# Mutual nearest neighbours from which a learned matcher is not asked: at least 65 of them agreed with one homography,
# three fifths of its own matches and more. [measured: docs/models.md]
EASY_PAIRS = 200
POINTS = 1024  # of an image in each rotation [spec: size of the LightGlue exports in docs/models.md]
QUARTER_TURNS = 4


@dataclass(frozen=True)
class LearnedFeatures(Features):
    """``turned``: keypoints of the image turned by 0 to 3 quarter turns, in pixels of that; ``places``: of each, the
    same points (N, 2) in pixels of the image. The fields of Features are those of the image as it is."""

    turned: tuple[Keypoints, ...] = ()
    places: tuple[np.ndarray, ...] = ()

    def coarse(self, factor: float, count: int) -> "LearnedFeatures":
        """The strongest ``count``, in pixels of the image: all features have one size."""
        turned = tuple(
            Keypoints(k.xy_px[:count], k.scores[:count], k.descriptors[:count], k.size_px) for k in self.turned
        )
        return _features(turned, tuple(place[:count] for place in self.places))


class LearnedMatcher:
    """``detector`` and ``matcher`` as opened by ``terrafix_engines.features.open_point_features``. Both raise
    ModelRunError."""

    def __init__(self, detector: Detector, matcher: PairMatcher) -> None:
        self.name = f"{detector.name}, {matcher.name}"
        self._detector, self._matcher, self._nearest = detector, matcher, MutualNearestMatcher()

    def describe(self, gray: np.ndarray) -> LearnedFeatures:
        turned, places = list[Keypoints](), list[np.ndarray]()
        for turns in range(QUARTER_TURNS):
            image = np.ascontiguousarray(np.rot90(gray, turns))
            found = self._detector.detect(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), POINTS)
            turned.append(found)
            places.append(_turned_back(found.xy_px, turns, gray.shape[1], gray.shape[0]))
        return _features(tuple(turned), tuple(places))

    def match(self, first: Features, second: Features) -> Matches:
        """In the rotation with most mutual nearest neighbours: a learned matcher finds wrong matches in all of them. Of
        an easy pair these neighbours are the matches, and the learned matcher does not run."""
        assert isinstance(first, LearnedFeatures) and isinstance(second, LearnedFeatures)
        turns, pairs = self._rotation(first, second)
        if len(pairs) < EASY_PAIRS:
            pairs, _ = self._matcher.match(first.turned[0], second.turned[turns])
        return Matches(first.places[0][pairs[:, 0]], second.places[turns][pairs[:, 1]])

    def shared(self, first: Features, second: Features) -> int:
        return len(self._rotation(first, second)[1])

    def _rotation(self, first: Features, second: Features) -> tuple[int, np.ndarray]:
        """-> the quarter turns of the second image with most mutual nearest neighbours, and these (N, 2)."""
        assert isinstance(first, LearnedFeatures) and isinstance(second, LearnedFeatures)
        pairs = [self._nearest.match(first.turned[0], turned)[0] for turned in second.turned]
        turns = int(np.argmax([len(one) for one in pairs]))
        return turns, pairs[turns]


def _features(turned: tuple[Keypoints, ...], places: tuple[np.ndarray, ...]) -> LearnedFeatures:
    return LearnedFeatures(places[0], turned[0].descriptors, np.ones(len(places[0]), np.float32), turned, places)


def _turned_back(xy_px: np.ndarray, turns: int, width: int, height: int) -> np.ndarray:
    """Points (N, 2) of an image of ``width`` x ``height`` that np.rot90 turned ``turns`` times -> in the image."""
    x, y = xy_px[:, 0], xy_px[:, 1]
    match turns:
        case 1:
            x, y = width - 1 - y, x
        case 2:
            x, y = width - 1 - x, height - 1 - y
        case 3:
            x, y = y, height - 1 - x
        case _:
            pass
    return np.column_stack([x, y]).astype(np.float32)
