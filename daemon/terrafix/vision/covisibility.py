"""Keyframes that see the ground of a frame that KLT does not track: the frame is registered to several of them.

Keyframes and their links are the co-visibility graph (ORB-SLAM, Mur-Artal et al. 2015) of the estimator's window, which
optimises it. Of photos with little overlap, the one before may show less of the ground of a frame than a line of the
survey that was flown minutes ago."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from terrafix.vision.features import FeatureMatcher, Features
from terrafix.vision.two_view import TwoView, verify

LINKS = 3  # keyframes that a frame is registered to [measured: docs/decisions/040]
CANDIDATES = 5  # that are verified, 13 ms each [measured: docs/decisions/040]
# Width of a smaller copy, and features of it, that are compared with every keyframe: of village-1's pairs within half a
# height, 40 frames and more apart, 86 % are found (360 px: 71 %), and none of 532 pairs four heights apart.
COARSE_WIDTH_PX, COARSE_FEATURES = 480, 300


@dataclass(frozen=True)
class View:
    """``features`` of an image, and the strongest ``coarse`` ones, as a copy of COARSE_WIDTH_PX shows them."""

    features: Features
    coarse: Features


class Covisibility:
    """Views of images of ``size_px`` (width, height), and the keyframes that share their ground."""

    def __init__(self, matcher: FeatureMatcher, size_px: tuple[int, int]) -> None:
        self._matcher, self._size_px = matcher, size_px
        self._coarse_scale = min(1.0, COARSE_WIDTH_PX / size_px[0])

    def describe(self, gray: np.ndarray) -> View:
        """(H, W) uint8 -> its view."""
        features = self._matcher.describe(gray)
        return View(features, features.coarse(self._coarse_scale, COARSE_FEATURES))

    def links(self, keyframes: Sequence[View], view: View) -> list[tuple[int, TwoView]]:
        """The keyframes of which ``view`` shows ground, as indices, with what both show: at most LINKS, the one with
        most inliers first. The CANDIDATES with most coarse matches are verified, in this order."""
        shared = [len(self._matcher.match(keyframe.coarse, view.coarse)) for keyframe in keyframes]
        found = list[tuple[int, TwoView]]()
        for i in sorted(range(len(keyframes)), key=lambda i: -shared[i])[:CANDIDATES]:
            two_view = verify(self._matcher.match(keyframes[i].features, view.features), self._size_px)
            if two_view is not None:
                found.append((i, two_view))
            if len(found) == LINKS:
                break
        return sorted(found, key=lambda link: -len(link[1].a_px))
