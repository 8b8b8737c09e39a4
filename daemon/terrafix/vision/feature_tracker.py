"""Frame-to-keyframe motion: KLT tracks at large overlap, else matches of features; one RANSAC homography in both cases
(two_view.py)."""

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.limits import MAX_KEYFRAME_AGE, WINDOW_NODES
from terrafix.core.node import Image
from terrafix.messages import Verdict
from terrafix.vision.covisibility import Covisibility, DescribedImage
from terrafix.vision.features import NO_POINTS, FeatureMatcher, SiftMatcher
from terrafix.vision.patch_alignment import align_patches, there_and_back
from terrafix.vision.two_view import (
    RANSAC_PX,
    TwoView,
    TwoViewGeometry,
    covers_image,
    homography_inliers,
    select_spread,
)

WORK_WIDTH_PX = 720  # resolves 0.2 m from 100 m; small enough for 10 frames per second on two cores
# Width of the copy, and features of it, in which a frame is compared that too little ties to its keyframes: of a pair
# with 24 matches on one plane they give 73. [measured: docs/decisions/040]
DETAIL_WIDTH_PX, DETAIL_FEATURES = 1200, 2000
MAX_CORNERS = 400
MIN_CORNER_DISTANCE_PX = 12
KLT_LEVELS = 4
SAMPLED = 8  # of so many corners one shows whether KLT follows at all [spec: 50 of MAX_CORNERS]
TRACK_RETURN_PX = 1.0  # forward-backward check: larger return error rejects a track (Kalal 2010)
TRACK_MIN_INLIERS = 20
TRACK_MIN_INLIER_RATIO = 0.35
# Median shift for a new keyframe, fraction of the image width: nine tenths still overlap. It moves smoothly and far
# from frame to frame, where the number of corners that are still tracked falls by a few: as the first to be reached, it
# chooses the same frame whichever of these are lost.
KEYFRAME_SHIFT = 0.12
KEYFRAME_TRACKED = 0.3  # minimum fraction of the keyframe's corners that are still tracked
MAX_TRACK_FAILURES = 5  # consecutive registration failures before a new fragment starts (PB-5)
MAX_ODOMETRY_PAIRS = 48
SIGMA_PX = 0.75  # 1-sigma of a matched coordinate; tracks drift with rotation and exposure steps (measured 0.4 to 0.9)
MAX_ODOMETRY_TRIPLES, MIN_ODOMETRY_TRIPLES = 96, 12
ALIGNED_SIGMA_PX = 0.25  # 1-sigma of a corner coordinate after patch alignment (measured 0.13 to 0.6)

_NO_TRIPLES, _NONE = np.zeros((0, 6)), np.zeros(0, int)


@dataclass
class _Keyframe:
    frame_id: int
    gray: np.ndarray
    corners: np.ndarray  # (N, 2) px
    previous_corners: np.ndarray  # (N, 2) px: the same corners in the previous keyframe; NaN: not observed there
    previous_keyframe_id: int  # frame id of the previous keyframe; meaningless where all of ``previous_corners`` is NaN
    view: DescribedImage | None = None  # None: not described yet
    age: int = 0
    registered: bool = False  # registered to an earlier keyframe, or a later frame was registered to it
    fragment_id: int = -1


@dataclass(frozen=True)
class KeyframeMatches:
    """Matches with one more keyframe of the fragment. ``two_view``, ``sigma_norm``, ``inliers``, ``tracked``: as in
    Motion."""

    keyframe_id: int
    two_view: np.ndarray
    sigma_norm: float
    inliers: int
    tracked: int


@dataclass(frozen=True)
class Motion:
    """Matches of a frame with its keyframe. ``two_view`` (N, 4): normalised coordinates (x_kf, y_kf, x, y).

    ``three_view`` (N, 6): normalised coordinates (x_prev, y_prev, x_kf, y_kf, x, y) of corners that the previous
    keyframe, frame ``previous_keyframe_id``, observed as well; only for a frame that becomes a keyframe.
    ``sigma_norm``, ``three_view_sigma_norm``: 1-sigma of a coordinate, normalised. ``fragment_id``: of the frame, as in
    Odometry; -1: it was not registered. ``links``: of a frame that KLT did not track. ``view``: of the frame, if it was
    described."""

    keyframe_id: int
    verdict: Verdict
    two_view: np.ndarray
    sigma_norm: float
    inliers: int
    tracked: int
    becomes_keyframe: bool
    previous_keyframe_id: int = -1
    three_view: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    three_view_sigma_norm: float = 0.0
    fragment_id: int = -1
    links: tuple[KeyframeMatches, ...] = ()
    view: DescribedImage | None = None


class FrameTracker:
    """Registers frames in order; stores the keyframes of the estimator's window and the last tracked frame.

    ``first_fragment_id``: number of the first fragment. ``mount``: of the camera. ``matcher``: of features, for frames
    that KLT does not track; None: SIFT."""

    def __init__(
        self,
        camera: CameraCalibration,
        first_fragment_id: int = 0,
        mount: Mount | None = None,
        matcher: FeatureMatcher | None = None,
    ) -> None:
        self._detail_scale = min(1.0, DETAIL_WIDTH_PX / camera.width)
        self._scale = min(1.0, WORK_WIDTH_PX / camera.width)
        self._camera = camera.scaled(self._scale)
        self._keyframe: _Keyframe | None = None
        self._last_gray: np.ndarray | None = None  # last tracked frame
        self._last_points = np.zeros((0, 2), np.float32)  # (N, 2) px: the keyframe's corners in that frame
        self._last_index = np.zeros(0, int)  # (N,) their indices in the keyframe
        self._failures = 0
        self._fragment_id = self._newest_fragment_id = first_fragment_id - 1  # of the keyframe; of the newest fragment
        self._failed_frame: _Keyframe | None = None  # last frame that failed: candidate for the start of a new fragment
        self._previous_fragment: _Keyframe | None = None  # last keyframe of the previous fragment
        self._linked: list[_Keyframe] = []  # keyframes that were registered by features, in the estimator's window
        self._size_px = (self._camera.width, self._camera.height)
        geometry = TwoViewGeometry(self._camera, mount)
        detailed = SiftMatcher(DETAIL_FEATURES)
        self._covisibility = Covisibility(matcher or SiftMatcher(), detailed, geometry, self._camera.width)

    def working_copy(self, image: Image) -> np.ndarray:
        """(H, W) gray image for tracking, at most WORK_WIDTH_PX wide."""
        return _gray_copy(image, self._scale)

    def track(self, frame_id: int, image: Image) -> Motion:
        """Registers a full-size image; see ``register``."""
        return self.register(frame_id, self.working_copy(image), image)

    def register(self, frame_id: int, gray: np.ndarray, image: Image) -> Motion:
        """Registers the next frame to a keyframe. ``gray``: the ``working_copy`` of ``image``."""
        keyframe = self._keyframe
        if keyframe is None:
            return self._new_fragment(frame_id, gray)
        keyframe.age += 1
        index, points, tracked = self._track_klt(keyframe, gray)
        enough = len(index) >= max(TRACK_MIN_INLIERS, TRACK_MIN_INLIER_RATIO * tracked)
        if enough and self._covers_images(keyframe.corners[index], points):
            return self._accept_tracks(keyframe, frame_id, gray, index, points, tracked)
        detail = _gray_copy(image, self._detail_scale) if self._detail_scale > self._scale else None
        current = _Keyframe(frame_id, gray, NO_POINTS, NO_POINTS, -1, self._covisibility.describe(gray, detail))
        # Two failed frames that match each other start a new fragment. One that matches nothing is a foreign frame.
        links = self._links(self._candidates(keyframe, frame_id), current)
        if not links and self._failed_frame is not None:
            links = self._links([self._failed_frame], current)
        return self._accept_links(current, links) if links else self._reject(keyframe, current, tracked)

    def _candidates(self, keyframe: _Keyframe, frame_id: int) -> list[_Keyframe]:
        """The keyframe; those that were registered by features, while the estimator holds them; and the last one of
        the previous fragment (after foreign frames, the flight continues where it was). A keyframe of tracked corners
        overlaps with the next one, which is the one to try."""
        self._linked = [k for k in self._linked if frame_id - k.frame_id <= WINDOW_NODES]
        others = [keyframe] if self._previous_fragment is None else [keyframe, self._previous_fragment]
        return [*self._linked, *(k for k in others if all(k is not linked for linked in self._linked))]

    def _links(self, keyframes: list[_Keyframe], current: _Keyframe) -> list[tuple[_Keyframe, TwoView]]:
        """Those of ``keyframes`` of which ``current`` shows ground, the one with most inliers first."""
        views = []
        for keyframe in (*keyframes, current):
            keyframe.view = keyframe.view or self._covisibility.describe(keyframe.gray)
            views.append(keyframe.view)
        return [(keyframes[i], two_view) for i, two_view in self._covisibility.links(views[:-1], views[-1])]

    def _accept_links(self, current: _Keyframe, links: list[tuple[_Keyframe, TwoView]]) -> Motion:
        """The frame is registered to the fragment that it was in, if that is among ``links``, else to that of the
        first. It becomes the keyframe: the KLT chain is broken and restarts from it."""
        first = next((k for k, _ in links if k.fragment_id == self._fragment_id), links[0][0])
        if first is self._failed_frame:
            self._begin_fragment()
            first.fragment_id = self._fragment_id
        elif first.fragment_id != self._fragment_id:
            self._previous_fragment, self._fragment_id = None, first.fragment_id
        first.registered = True
        self._start_keyframe(current.frame_id, current.gray, view=current.view)
        assert self._keyframe is not None
        self._linked = [k for k in self._linked if k is not first] + [first, self._keyframe]
        (_, two_view), *others = [(k, seen) for k, seen in links if k.fragment_id == self._fragment_id]
        motion = self._build_motion(first, two_view.a_px, two_view.b_px, len(two_view.a_px), two_view.matches, due=True)
        return replace(motion, links=tuple(self._link(k, seen) for k, seen in others), view=current.view)

    def _link(self, keyframe: _Keyframe, seen: TwoView) -> KeyframeMatches:
        two_view, sigma_norm = self._published(seen.a_px, seen.b_px, len(seen.a_px), seen.matches)
        return KeyframeMatches(keyframe.frame_id, two_view, sigma_norm, len(seen.a_px), seen.matches)

    def _track_klt(self, keyframe: _Keyframe, gray: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """KLT from the last tracked frame. -> indices (N,) of the keyframe's corners that agree with one homography,
        their positions (N, 2) px in this frame, and the number of tracked corners."""
        if self._last_gray is None or len(self._last_points) < TRACK_MIN_INLIERS:
            return _NONE, NO_POINTS, 0
        start = self._last_points.reshape(-1, 1, 2)
        if keyframe.view is not None:  # features were needed since: photos of which KLT can follow few
            _, came_back = there_and_back(self._last_gray, gray, start[::SAMPLED].copy(), TRACK_RETURN_PX, KLT_LEVELS)
            if SAMPLED * came_back.sum() < TRACK_MIN_INLIERS / 2:
                return _NONE, NO_POINTS, 0
        ahead, keep = there_and_back(self._last_gray, gray, start, TRACK_RETURN_PX, KLT_LEVELS)
        positions, index = ahead.reshape(-1, 2)[keep], self._last_index[keep]
        inlier = homography_inliers(keyframe.corners[index], positions)
        if inlier.sum() >= TRACK_MIN_INLIERS:
            self._last_points, self._last_index, self._last_gray = positions[inlier], index[inlier], gray
        return index[inlier], positions[inlier], int(keep.sum())

    def _accept_tracks(
        self, keyframe: _Keyframe, frame_id: int, gray: np.ndarray, index: np.ndarray, points: np.ndarray, tracked: int
    ) -> Motion:
        """``points`` (N, 2) px: tracked positions of the keyframe's corners ``index`` (N,)."""
        corners = keyframe.corners[index]
        shift = float(np.median(np.linalg.norm(corners - points, axis=1))) / self._camera.width
        due = (
            shift > KEYFRAME_SHIFT
            or len(index) < KEYFRAME_TRACKED * max(len(keyframe.corners), 1)
            or keyframe.age >= MAX_KEYFRAME_AGE
        )
        aligned, valid = align_patches(keyframe.gray, corners, gray, points, RANSAC_PX)
        triples = _NO_TRIPLES
        if due:
            triples = self._triples(keyframe, aligned, index[valid])
            self._start_keyframe(frame_id, gray, aligned, corners[valid], keyframe.frame_id)
        # Patch alignment fails on a blurred image, but the tracks are still valid.
        if len(valid) < TRACK_MIN_INLIERS or not self._covers_images(aligned, aligned):
            aligned, valid = points, np.arange(len(points))
        return self._build_motion(keyframe, corners[valid], aligned, len(index), tracked, due=due, triples=triples)

    def _covers_images(self, a: np.ndarray, b: np.ndarray) -> bool:
        return covers_image(a, self._size_px) and covers_image(b, self._size_px)

    def _triples(self, keyframe: _Keyframe, positions: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Three-view matches (N, 6), normalised, of the corners ``index`` at ``positions`` (N, 2) px."""
        three = np.isfinite(keyframe.previous_corners[index, 0])
        if three.sum() < MIN_ODOMETRY_TRIPLES:
            return _NO_TRIPLES
        positions, index = positions[three], index[three]
        pick = select_spread(keyframe.corners[index], MAX_ODOMETRY_TRIPLES, self._size_px)
        views = keyframe.previous_corners[index[pick]], keyframe.corners[index[pick]], positions[pick]
        return np.hstack([self._camera.normalise(px) for px in views])

    def _build_motion(
        self,
        keyframe: _Keyframe,
        a: np.ndarray,
        b: np.ndarray,
        inliers: int,
        tracked: int,
        *,
        due: bool,
        triples: np.ndarray = _NO_TRIPLES,
    ) -> Motion:
        """Motion from inlier matches (N, 2), (N, 2) px; ``inliers`` of ``tracked`` matches agree with it."""
        self._failures, self._failed_frame = 0, None
        if self._keyframe is not None:
            self._keyframe.registered = True
        two_view, sigma_norm = self._published(a, b, inliers, tracked)
        return Motion(
            keyframe.frame_id,
            Verdict.ACCEPTED,
            two_view,
            sigma_norm,
            inliers,
            tracked,
            due,
            keyframe.previous_keyframe_id if len(triples) else -1,
            triples,
            ALIGNED_SIGMA_PX / self._camera.fx,
            self._fragment_id,
        )

    def _published(self, a: np.ndarray, b: np.ndarray, inliers: int, tracked: int) -> tuple[np.ndarray, float]:
        """-> at most MAX_ODOMETRY_PAIRS of the matches (N, 2), (N, 2) px, normalised (M, 4); 1-sigma of one."""
        pick = select_spread(a, MAX_ODOMETRY_PAIRS, self._size_px)
        two_view = np.hstack([self._camera.normalise(a[pick]), self._camera.normalise(b[pick])])
        # A consensus with a low inlier ratio may be a roof instead of the ground: its sigma is larger.
        return two_view, SIGMA_PX / self._camera.fx / float(np.sqrt(inliers / tracked))

    def _reject(self, keyframe: _Keyframe, current: _Keyframe, tracked: int) -> Motion:
        """Registration failed. Starts a new fragment after MAX_TRACK_FAILURES, or when the keyframe is too old."""
        self._failures += 1
        if self._failures >= MAX_TRACK_FAILURES or keyframe.age >= MAX_KEYFRAME_AGE:
            return replace(self._new_fragment(current.frame_id, current.gray, current.view), view=current.view)
        self._failed_frame = current
        return Motion(
            keyframe.frame_id, Verdict.FEW_INLIERS, np.zeros((0, 4)), 0.0, 0, tracked, False, view=current.view
        )

    def _begin_fragment(self) -> None:
        """The next fragment. A keyframe to which no other frame was registered is not a candidate for a return."""
        if self._keyframe is not None and self._keyframe.registered:
            self._previous_fragment = self._keyframe
        self._newest_fragment_id += 1
        self._fragment_id = self._newest_fragment_id

    def _new_fragment(self, frame_id: int, gray: np.ndarray, view: DescribedImage | None = None) -> Motion:
        """The frame starts a fragment: it has no motion, later frames are registered to it."""
        self._begin_fragment()
        self._start_keyframe(frame_id, gray, view=view)
        self._failures, self._failed_frame = 0, None
        return Motion(frame_id, Verdict.ACCEPTED, np.zeros((0, 4)), 0.0, 0, 0, True, fragment_id=self._fragment_id)

    def _start_keyframe(
        self,
        frame_id: int,
        gray: np.ndarray,
        carried: np.ndarray = NO_POINTS,
        previous_corners: np.ndarray = NO_POINTS,
        previous_keyframe_id: int = -1,
        view: DescribedImage | None = None,
    ) -> None:
        """The frame becomes the keyframe. Corners ``carried`` (N, 2) px were at ``previous_corners`` (N, 2) in the last
        keyframe; new ones are detected in the areas without corners."""
        empty = np.full(gray.shape, 255, np.uint8)
        for x, y in np.round(carried).astype(int):
            cv2.circle(empty, (int(x), int(y)), MIN_CORNER_DISTANCE_PX, 0, -1)
        missing_count = MAX_CORNERS - len(carried)
        corners = (
            cv2.goodFeaturesToTrack(gray, missing_count, 0.005, MIN_CORNER_DISTANCE_PX, mask=empty)
            if missing_count
            else None
        )
        new = corners.reshape(-1, 2).astype(np.float32) if corners is not None else NO_POINTS
        found = np.vstack([carried, new])
        unseen = np.full((len(new), 2), np.nan, np.float32)
        self._keyframe = _Keyframe(
            frame_id,
            gray,
            found,
            np.vstack([previous_corners, unseen]),
            previous_keyframe_id,
            view,
            fragment_id=self._fragment_id,
        )
        self._last_gray, self._last_points, self._last_index = gray, found, np.arange(len(found))


def _gray_copy(image: Image, scale: float) -> np.ndarray:
    """(H, W) uint8: the image in gray, smaller by ``scale``."""
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    if scale < 1.0:
        size_px = round(image.shape[1] * scale), round(image.shape[0] * scale)
        gray = cv2.resize(gray, size_px, interpolation=cv2.INTER_AREA)
    return gray
