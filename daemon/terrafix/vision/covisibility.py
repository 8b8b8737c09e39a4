"""Keyframes that see the ground of a frame that KLT does not track: the frame is registered to several of them.

Keyframes and their links are the co-visibility graph (ORB-SLAM, Mur-Artal et al. 2015) of the estimator's window, which
optimises it. Of photos with little overlap, the one before may show less of the ground of a frame than a line of the
survey that was flown minutes ago."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from terrafix.vision.features import FeatureMatcher, Features
from terrafix.vision.two_view import TwoView, TwoViewGeometry

LINKS = 3  # keyframes that a frame is registered to [measured: docs/decisions/040]
WINDOW_CANDIDATES = 5  # that are verified [measured: docs/decisions/040]
# Width of a smaller copy, and features of it, that are compared with every keyframe: of village-1's pairs within half a
# height, 40 frames and more apart, 86 % are found (360 px: 71 %), and none of 532 pairs four heights apart.
COARSE_WIDTH_PX, COARSE_FEATURES = 480, 300
# of the most coarse matches, that another keyframe needs after an easy pair [spec: half the overlap]
LIKELY_SHARE = 0.5
WEAK_INLIERS = 30  # of the best keyframe, below which details are compared [measured: docs/decisions/040]
MIN_EPIPOLAR = 20  # of matches on epipolar lines, for that: by chance 14 at most [measured: docs/decisions/040]


@dataclass(frozen=True)
class DescribedImage:
    """``features`` of an image, and the strongest ``coarse`` ones, as a copy of COARSE_WIDTH_PX shows them. ``detail``:
    (H, W) uint8, a larger copy of the image; None: there is none."""

    features: Features
    coarse: Features
    detail: np.ndarray | None = None


class Covisibility:
    """Views of images of ``width_px``, and the keyframes that share their ground. ``detailed``: describes the details
    of a view, of whatever the features are."""

    def __init__(
        self, matcher: FeatureMatcher, detailed: FeatureMatcher, geometry: TwoViewGeometry, width_px: int
    ) -> None:
        self._matcher, self._detailed, self._geometry, self._width_px = matcher, detailed, geometry, width_px

    def describe(self, gray: np.ndarray, detail: np.ndarray | None = None) -> DescribedImage:
        """(H, W) uint8 -> its view. ``detail``: as in DescribedImage."""
        features = self._matcher.describe(gray)
        coarse = features.coarse(min(1.0, COARSE_WIDTH_PX / self._width_px), COARSE_FEATURES)
        return DescribedImage(features, coarse, detail)

    def links(self, keyframes: Sequence[DescribedImage], view: DescribedImage) -> list[tuple[int, TwoView]]:
        """The keyframes of which ``view`` shows ground, as indices, with what both show: at most LINKS, the one with
        most inliers first. The WINDOW_CANDIDATES with most coarse matches are verified, in this order."""
        shared = [self._matcher.shared(keyframe.coarse, view.coarse) for keyframe in keyframes]
        seen, verified, most = dict[int, TwoView](), dict[int, TwoView](), 0
        for i in sorted(range(len(keyframes)), key=lambda i: -shared[i])[:WINDOW_CANDIDATES]:
            # After an easy pair only those keyframes are compared that are likely to show as much.
            if len(verified) == LINKS or (most >= WEAK_INLIERS and shared[i] < LIKELY_SHARE * max(shared)):
                break
            seen[i] = self._geometry.fit(self._matcher.match(keyframes[i].features, view.features))
            if self._geometry.is_verified(seen[i]):
                verified[i], most = seen[i], max(most, len(seen[i].a_px))
        if seen and most < WEAK_INLIERS:
            best = max(seen, key=lambda i: len(seen[i].lines_a_px))
            two_view = self._in_detail(keyframes[best], view, seen[best])
            if two_view is not None and len(two_view.a_px) > len(seen[best].a_px):
                verified[best] = two_view
        return sorted(verified.items(), key=lambda link: -len(link[1].a_px))

    def _in_detail(self, keyframe: DescribedImage, view: DescribedImage, seen: TwoView) -> TwoView | None:
        """What both show, by features of larger copies of the parts that ``seen`` matches; None: there are no such
        copies, or it is not enough."""
        if keyframe.detail is None or view.detail is None or len(seen.lines_a_px) < MIN_EPIPOLAR:
            return None
        first = self._details(keyframe.detail, seen.lines_a_px)
        return self._geometry.verify(self._detailed.match(first, self._details(view.detail, seen.lines_b_px)))

    def _details(self, detail: np.ndarray, xy_px: np.ndarray) -> Features:
        """Features of the part of the larger copy around the points (N, 2), in pixels of the image."""
        scale = detail.shape[1] / self._width_px
        left, top = np.maximum(xy_px.min(axis=0) * scale, 0.0).astype(int)
        right, bottom = np.ceil(xy_px.max(axis=0) * scale).astype(int) + 1
        part = self._detailed.describe(np.ascontiguousarray(detail[top:bottom, left:right]))
        return replace(part, xy_px=part.xy_px + np.array((left, top), np.float32)).scaled(1.0 / scale)
