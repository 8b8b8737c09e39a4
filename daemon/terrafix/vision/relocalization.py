"""Relocalisation: frames against the kept keyframes of all fragments (loop closing and relocalisation of ORB-SLAM,
Mur-Artal et al. 2015): candidates by bag of words, then geometric verification."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.messages import Frame, Relocalization
from terrafix.vision.covisibility import COARSE_FEATURES, COARSE_WIDTH_PX
from terrafix.vision.feature_tracker import MAX_ODOMETRY_PAIRS, SIGMA_PX, Motion
from terrafix.vision.features import Features, SiftMatcher
from terrafix.vision.keyframe_database import KeyframeDatabase, StoredKeyframe
from terrafix.vision.two_view import TwoView, TwoViewGeometry, select_spread

DATABASE_CANDIDATES = 5  # that are verified: 3 ms each
INTERVAL_NS = 1_000_000_000  # between two searches: 50 ms of one core, 5 % of its time
# Image widths of way, from which a keyframe of the same fragment is another visit to its ground. Shorter loops would be
# a second odometry whose scale errors, which are those of the first, the estimator would take for independent.
APART = 1.5
SAME_VIEW_SHIFT = 0.22  # fraction of the image width: two views closer than that share three quarters of their ground
OLDEST_SHARE = 0.5  # of the inliers of the best candidate: an older one with so many has drifted less


@dataclass(frozen=True)
class _View:
    """A frame as it is compared. ``path``: as in StoredKeyframe. ``linked``: keyframes that it is registered to."""

    frame_id: int
    fragment_id: int
    path: float
    features: Features
    linked: frozenset[int]

    def is_recent(self, keyframe: StoredKeyframe) -> bool:
        """Whether this is still the same visit to the ground of the keyframe, or odometry already has what both see."""
        same_visit = keyframe.fragment_id == self.fragment_id and abs(self.path - keyframe.path) < APART
        return same_visit or keyframe.frame_id in self.linked


class RelocalizationSearch:
    """``on_frame`` with every frame, in order, after its registration."""

    def __init__(
        self, camera: CameraCalibration, mount: Mount | None = None, database: KeyframeDatabase | None = None
    ) -> None:
        self._scale = min(1.0, COARSE_WIDTH_PX / camera.width)
        self._camera = camera.scaled(self._scale)
        self._matcher, self._geometry = SiftMatcher(COARSE_FEATURES), TwoViewGeometry(self._camera, mount)
        self.database = KeyframeDatabase() if database is None else database
        self._path: dict[int, float] = {}  # fragment -> way to its newest keyframe, image widths
        self._first: _View | None = None  # first frame of a fragment: kept once a second one is registered to it
        self._searched_ns: int | None = None

    def on_frame(self, frame: Frame, gray: np.ndarray, motion: Motion, *, busy: bool) -> Relocalization | None:
        """``gray``: the working copy of the tracker, ``motion`` its result, whose view is used if it has one. ``busy``:
        frames were dropped since the frame before. Keyframes are stored, and they and frames that nothing is registered
        to are searched for: at most one in INTERVAL_NS, and none while the process is busy."""
        self._keep_first(motion)
        lost = motion.fragment_id < 0
        if motion.becomes_keyframe:
            before = self._path.get(motion.fragment_id, 0.0)
            self._path[motion.fragment_id] = before + self._shift(motion)
        if busy or not (lost or motion.becomes_keyframe) or not self._is_due(frame.t_ns):
            return None
        self._searched_ns = frame.t_ns
        path = self._path.get(motion.fragment_id, 0.0)
        features = self._describe(gray) if motion.view is None else motion.view.coarse
        linked = frozenset((motion.keyframe_id, *(link.keyframe_id for link in motion.links)))
        view = _View(frame.frame_id, motion.fragment_id, path, features, linked)
        verified = self._verified(view)
        known = any(self._is_same_ground(two_view) for _, two_view in verified)
        if not lost and not (known and self.database.has_fragment(view.fragment_id)):
            self._store(view, registered=len(motion.two_view) > 0)
        return self._message(frame, view, *_oldest(verified)) if verified else None

    def _is_due(self, t_ns: int) -> bool:
        return self._searched_ns is None or t_ns - self._searched_ns >= INTERVAL_NS

    def _store(self, view: _View, *, registered: bool) -> None:
        if not registered:
            self._first = view
            return
        self.database.add(view.frame_id, view.fragment_id, view.path, view.features)

    def _keep_first(self, motion: Motion) -> None:
        """The first frame of a fragment is kept when another one is registered to it; else it is a foreign frame."""
        first, self._first = self._first, None
        if first is None:
            return
        if motion.keyframe_id == first.frame_id and len(motion.two_view) > 0:
            self._store(first, registered=True)
        elif motion.fragment_id < 0:
            self._first = first

    def _shift(self, motion: Motion) -> float:
        """Median displacement of the matches of a frame with its keyframe, image widths."""
        if len(motion.two_view) == 0:
            return 0.0
        moved = np.linalg.norm(motion.two_view[:, 2:] - motion.two_view[:, :2], axis=1)
        return float(np.median(moved)) * self._camera.fx / self._camera.width

    def _describe(self, gray: np.ndarray) -> Features:
        size = (self._camera.width, self._camera.height)
        if gray.shape[::-1] != size:
            gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        return self._matcher.describe(gray)

    def _verified(self, view: _View) -> list[tuple[StoredKeyframe, TwoView]]:
        """The candidates whose ground ``view`` shows."""
        verified = list[tuple[StoredKeyframe, TwoView]]()
        for keyframe in self.database.candidates(view.features, view.is_recent, DATABASE_CANDIDATES):
            two_view = self._geometry.verify(self._matcher.match(_unpacked(keyframe.features), view.features))
            if two_view is not None:
                verified.append((keyframe, two_view))
        return verified

    def _is_same_ground(self, two_view: TwoView) -> bool:
        """Whether a kept keyframe shows the ground of the frame so well that the frame need not be kept: their centres
        are closer than two keyframes are."""
        h, _ = cv2.findHomography(two_view.a_px, two_view.b_px)
        if h is None:
            return False
        centre = np.array([[[self._camera.width / 2, self._camera.height / 2]]])
        moved = np.linalg.norm(cv2.perspectiveTransform(centre, h) - centre)
        return float(moved) < SAME_VIEW_SHIFT * self._camera.width

    def _message(self, frame: Frame, view: _View, keyframe: StoredKeyframe, two_view: TwoView) -> Relocalization:
        pick = select_spread(two_view.a_px, MAX_ODOMETRY_PAIRS, (self._camera.width, self._camera.height))
        pairs = np.hstack([self._camera.normalise(px[pick]) for px in (two_view.a_px, two_view.b_px)])
        return Relocalization(
            t_ns=frame.t_ns,
            frame_id=frame.frame_id,
            fragment_id=view.fragment_id,
            keyframe_id=keyframe.frame_id,
            keyframe_fragment_id=keyframe.fragment_id,
            two_view=[(float(a), float(b), float(c), float(d)) for a, b, c, d in pairs],
            # The error of a feature is that of the tracker's, in pixels of the smaller copy.
            sigma_norm=SIGMA_PX / self._camera.fx / float(np.sqrt(len(two_view.a_px) / two_view.matches)),
            inliers=len(two_view.a_px),
            tracked=two_view.matches,
        )


def _oldest(verified: list[tuple[StoredKeyframe, TwoView]]) -> tuple[StoredKeyframe, TwoView]:
    """The oldest keyframe with OLDEST_SHARE of the most inliers."""
    most = max(len(two_view.a_px) for _, two_view in verified)
    good = [found for found in verified if len(found[1].a_px) >= OLDEST_SHARE * most]
    return min(good, key=lambda found: found[0].frame_id)


def _unpacked(features: Features) -> Features:
    return Features(features.xy_px, features.descriptors.astype(np.float32), features.size_px)
