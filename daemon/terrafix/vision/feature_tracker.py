"""Frame-to-keyframe motion: KLT tracks at large overlap, else SIFT matches; one RANSAC homography in both cases.

From flying height the ground is close to a plane, so its matches agree with one homography. Points above the ground
fail the RANSAC threshold or add noise, which the covariance includes."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.limits import MAX_KEYFRAME_AGE
from terrafix.core.node import Image
from terrafix.messages import Verdict
from terrafix.vision.patch_alignment import align_patches

WORK_WIDTH_PX = 720  # resolves 0.2 m from 100 m; small enough for 10 frames per second on two cores
MAX_CORNERS = 400
MIN_CORNER_DISTANCE_PX = 12
KLT_WINDOW_PX = 21
KLT_LEVELS = 4
FORWARD_BACKWARD_PX = 1.0  # forward-backward check: larger return error rejects a track (Kalal 2010)
RANSAC_PX = 2.5  # 0.4 m from 100 m; excludes points above the ground
MIN_INLIERS = 20
MIN_INLIER_RATIO = 0.35
MIN_SPREAD = 0.12  # inliers must span this fraction of image width and height, else the pose is not determined
MIN_INLIERS_FEATURES = 15  # by chance, 4 to 8 of 100 wrong matches agree
MIN_INLIER_RATIO_FEATURES = 0.15
KEYFRAME_SHIFT = 0.22  # median shift for a new keyframe, fraction of the image width: three quarters still overlap
KEYFRAME_TRACKED = 0.45  # minimum fraction of the keyframe's corners that are still tracked
MAX_FAILURES = 5  # consecutive registration failures before a new fragment starts (PB-5)
MAX_PAIRS = 48
SIGMA_PX = 0.75  # 1-sigma of a matched coordinate; tracks drift with rotation and exposure steps (measured 0.4 to 0.9)
MAX_TRIPLES, MIN_TRIPLES = 96, 12
ALIGNED_SIGMA_PX = 0.25  # 1-sigma of a corner coordinate after patch alignment (measured 0.13 to 0.6)
SIFT_FEATURES = 1500
SIFT_RATIO = 0.8  # ratio test, Lowe 2004

_NO_POINTS, _NO_TRIPLES, _NONE = np.zeros((0, 2), np.float32), np.zeros((0, 6)), np.zeros(0, int)


@dataclass
class _Keyframe:
    frame_id: int
    gray: np.ndarray
    corners: np.ndarray  # (N, 2) px
    previous_corners: np.ndarray  # (N, 2) px: the same corners in the previous keyframe; NaN: not observed there
    previous_keyframe_id: int  # frame id of the previous keyframe; meaningless where all of ``previous_corners`` is NaN
    sift: tuple[np.ndarray, np.ndarray] | None = None  # points (N, 2) px, descriptors (N, 128); computed on demand
    age: int = 0
    registered: bool = False  # registered to an earlier keyframe, or a later frame was registered to it
    fragment_id: int = -1


@dataclass(frozen=True)
class Motion:
    """Matches of a frame with its keyframe. ``two_view`` (N, 4): normalised coordinates (x_kf, y_kf, x, y).

    ``three_view`` (N, 6): normalised coordinates (x_prev, y_prev, x_kf, y_kf, x, y) of corners that the previous
    keyframe, frame ``previous_keyframe_id``, observed as well; only for a frame that becomes a keyframe.
    ``sigma_norm``, ``three_view_sigma_norm``: 1-sigma of a coordinate, normalised. ``fragment_id``: of the frame, as in
    Odometry; -1: it was not registered."""

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


class FrameTracker:
    """Registers frames in order; stores one keyframe and the last tracked frame.

    ``first_fragment_id``: number of the first fragment."""

    def __init__(self, camera: CameraCalibration, first_fragment_id: int = 0) -> None:
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
        self._sift = cv2.SIFT.create(nfeatures=SIFT_FEATURES, enable_precise_upscale=True)

    def working_copy(self, image: Image) -> np.ndarray:
        """(H, W) gray image for tracking, at most WORK_WIDTH_PX wide."""
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self._scale < 1.0:
            gray = cv2.resize(gray, (self._camera.width, self._camera.height), interpolation=cv2.INTER_AREA)
        return gray

    def track(self, frame_id: int, image: Image) -> Motion:
        """Registers a full-size image; see ``register``."""
        return self.register(frame_id, self.working_copy(image))

    def register(self, frame_id: int, gray: np.ndarray) -> Motion:
        """Registers the next frame to a keyframe. ``gray``: its ``working_copy``."""
        keyframe = self._keyframe
        if keyframe is None:
            return self._new_fragment(frame_id, gray)
        keyframe.age += 1
        index, points, tracked = self._track_klt(keyframe, gray)
        if self._determines_motion(keyframe.corners[index], points, tracked, MIN_INLIERS, MIN_INLIER_RATIO):
            return self._accept_tracks(keyframe, frame_id, gray, index, points, tracked)
        # Feature matching against three candidates: the keyframe; the last keyframe of the previous fragment (after
        # foreign frames, the flight continues where it was); the last failed frame. Two failed frames that match each
        # other start a new fragment; one that matches no candidate is a foreign frame.
        current = _Keyframe(frame_id, gray, _NO_POINTS, _NO_POINTS, -1, self._describe(gray))
        for candidate in (keyframe, self._previous_fragment, self._failed_frame):
            if candidate is None:
                continue
            points_kf, points = self._match_features(candidate, current)
            inlier, matched = _homography_inliers(points_kf, points), len(points)
            points_kf, points = points_kf[inlier], points[inlier]
            if self._determines_motion(points_kf, points, matched, MIN_INLIERS_FEATURES, MIN_INLIER_RATIO_FEATURES):
                if candidate is self._failed_frame:
                    self._begin_fragment()
                elif candidate is self._previous_fragment:
                    self._previous_fragment, self._fragment_id = None, candidate.fragment_id
                # The KLT chain is broken; it restarts from this frame.
                self._start_keyframe(frame_id, gray)
                return self._build_motion(candidate, points_kf, points, len(points), matched, due=True)
        return self._reject(keyframe, current, tracked)

    def _track_klt(self, keyframe: _Keyframe, gray: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """KLT from the last tracked frame. -> indices (N,) of the keyframe's corners that agree with one homography,
        their positions (N, 2) px in this frame, and the number of tracked corners."""
        if self._last_gray is None or len(self._last_points) < MIN_INLIERS:
            return _NONE, _NO_POINTS, 0
        window = (KLT_WINDOW_PX, KLT_WINDOW_PX)
        start = self._last_points.reshape(-1, 1, 2)
        ahead, ok, _ = cv2.calcOpticalFlowPyrLK(
            self._last_gray, gray, start, np.zeros_like(start), winSize=window, maxLevel=KLT_LEVELS
        )
        back, ok_back, _ = cv2.calcOpticalFlowPyrLK(
            gray, self._last_gray, ahead, start.copy(), winSize=window, maxLevel=KLT_LEVELS
        )
        closed = np.linalg.norm((back - start).reshape(-1, 2), axis=1) < FORWARD_BACKWARD_PX
        keep = (ok.ravel() == 1) & (ok_back.ravel() == 1) & closed
        positions, index = ahead.reshape(-1, 2)[keep], self._last_index[keep]
        inlier = _homography_inliers(keyframe.corners[index], positions)
        if inlier.sum() >= MIN_INLIERS:
            self._last_points, self._last_index, self._last_gray = positions[inlier], index[inlier], gray
        return index[inlier], positions[inlier], int(keep.sum())

    def _match_features(self, keyframe: _Keyframe, current: _Keyframe) -> tuple[np.ndarray, np.ndarray]:
        """SIFT matches, for large displacements and rotations. -> points in both frames (N, 2), (N, 2), px."""
        if keyframe.sift is None:
            keyframe.sift = self._describe(keyframe.gray)
        (points_kf, descriptors_kf), (points, descriptors) = keyframe.sift, current.sift or self._describe(current.gray)
        if len(points_kf) < 2 or len(points) < 2:
            return _NO_POINTS, _NO_POINTS
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_kf, descriptors, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < SIFT_RATIO * p[1].distance]
        if not good:
            return _NO_POINTS, _NO_POINTS
        return points_kf[[m.queryIdx for m in good]], points[[m.trainIdx for m in good]]

    def _describe(self, gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """SIFT points (N, 2) px and descriptors (N, 128)."""
        keypoints, descriptors = self._sift.detectAndCompute(gray, None)
        if descriptors is None:
            return _NO_POINTS, np.zeros((0, 128), np.float32)
        return np.array([k.pt for k in keypoints], np.float32), descriptors

    def _determines_motion(
        self, a: np.ndarray, b: np.ndarray, matches: int, min_inliers: int, min_ratio: float
    ) -> bool:
        """True when the inliers (N, 2), (N, 2), out of ``matches``, are enough and cover enough of the image."""
        return (
            len(a) >= min_inliers and len(a) >= min_ratio * matches and self._covers_image(a) and self._covers_image(b)
        )

    def _covers_image(self, points: np.ndarray) -> bool:
        """True when the points (N, 2) px cover enough of the image in both directions."""
        size = (self._camera.width, self._camera.height)
        return bool(np.all(np.ptp(points, axis=0) > np.multiply(size, MIN_SPREAD)))

    def _accept_tracks(
        self,
        keyframe: _Keyframe,
        frame_id: int,
        gray: np.ndarray,
        index: np.ndarray,
        points: np.ndarray,
        tracked: int,
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
        if len(valid) < MIN_INLIERS or not self._covers_image(aligned):
            aligned, valid = points, np.arange(len(points))
        return self._build_motion(keyframe, corners[valid], aligned, len(index), tracked, due=due, triples=triples)

    def _triples(self, keyframe: _Keyframe, positions: np.ndarray, index: np.ndarray) -> np.ndarray:
        """Three-view matches (N, 6), normalised, of the corners ``index`` at ``positions`` (N, 2) px."""
        three = np.isfinite(keyframe.previous_corners[index, 0])
        if three.sum() < MIN_TRIPLES:
            return _NO_TRIPLES
        positions, index = positions[three], index[three]
        pick = _select_spread(keyframe.corners[index], MAX_TRIPLES)
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
        pick = _select_spread(a, MAX_PAIRS)
        return Motion(
            keyframe.frame_id,
            Verdict.ACCEPTED,
            np.hstack([self._camera.normalise(a[pick]), self._camera.normalise(b[pick])]),
            # A consensus with a low inlier ratio may be a roof instead of the ground: its sigma is larger.
            SIGMA_PX / self._camera.fx / float(np.sqrt(inliers / tracked)),
            inliers,
            tracked,
            due,
            keyframe.previous_keyframe_id if len(triples) else -1,
            triples,
            ALIGNED_SIGMA_PX / self._camera.fx,
            self._fragment_id,
        )

    def _reject(self, keyframe: _Keyframe, current: _Keyframe, tracked: int) -> Motion:
        """Registration failed. Starts a new fragment after MAX_MISSES failures, or when the keyframe is too old."""
        self._failures += 1
        if self._failures >= MAX_FAILURES or keyframe.age >= MAX_KEYFRAME_AGE:
            return self._new_fragment(current.frame_id, current.gray)
        self._failed_frame = current
        return Motion(keyframe.frame_id, Verdict.FEW_INLIERS, np.zeros((0, 4)), 0.0, 0, tracked, False)

    def _begin_fragment(self) -> None:
        """The next fragment. A keyframe to which no other frame was registered is not a candidate for a return."""
        if self._keyframe is not None and self._keyframe.registered:
            self._previous_fragment = self._keyframe
        self._newest_fragment_id += 1
        self._fragment_id = self._newest_fragment_id

    def _new_fragment(self, frame_id: int, gray: np.ndarray) -> Motion:
        """The frame starts a fragment: it has no motion, later frames are registered to it."""
        self._begin_fragment()
        self._start_keyframe(frame_id, gray)
        self._failures, self._failed_frame = 0, None
        return Motion(frame_id, Verdict.ACCEPTED, np.zeros((0, 4)), 0.0, 0, 0, True, fragment_id=self._fragment_id)

    def _start_keyframe(
        self,
        frame_id: int,
        gray: np.ndarray,
        carried: np.ndarray = _NO_POINTS,
        previous_corners: np.ndarray = _NO_POINTS,
        previous_keyframe_id: int = -1,
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
        new = corners.reshape(-1, 2).astype(np.float32) if corners is not None else _NO_POINTS
        found = np.vstack([carried, new])
        unseen = np.full((len(new), 2), np.nan, np.float32)
        self._keyframe = _Keyframe(
            frame_id,
            gray,
            found,
            np.vstack([previous_corners, unseen]),
            previous_keyframe_id,
            fragment_id=self._fragment_id,
        )
        self._last_gray, self._last_points, self._last_index = gray, found, np.arange(len(found))


def _homography_inliers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) bool: matches (N, 2), (N, 2) px that agree with one RANSAC homography."""
    if len(a) < 8:
        return np.zeros(len(a), bool)
    _, mask = cv2.findHomography(a, b, cv2.RANSAC, RANSAC_PX, maxIters=1500, confidence=0.999)
    return np.zeros(len(a), bool) if mask is None else mask.ravel().astype(bool)


def _select_spread(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, round-robin over an 8 x 6 grid, for an even distribution over the image."""
    if len(points) <= limit:
        return np.arange(len(points))
    low, span = points.min(0), np.maximum(np.ptp(points, axis=0), 1.0)
    cell = np.minimum((points - low) / span * (8, 6), (7, 5)).astype(int)
    key = cell[:, 1] * 8 + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[True, np.diff(key[order]) > 0]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    return np.sort(order[np.argsort(rank, kind="stable")[:limit]])
