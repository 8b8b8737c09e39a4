"""Frame-to-keyframe motion: KLT while the overlap is large, SIFT when it is not, one RANSAC homography either way.

The ground is close to a plane seen from flying height, so a homography holds the matches together; what stands
above it is left out by the RANSAC threshold or enters as noise, which the covariance states."""

from dataclasses import dataclass, field

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.node import Image
from terrafix.messages import Verdict
from terrafix.vision.patch_alignment import realigned

WORK_WIDTH_PX = 720  # wide enough for 0.2 m detail at 100 m, small enough for 10 frames a second on two cores
MAX_CORNERS = 400
MIN_CORNER_DISTANCE_PX = 12
MIN_CORNERS = 40
KLT_WINDOW_PX = 21
KLT_LEVELS = 4
FORWARD_BACKWARD_PX = 1.0  # a track that does not come back to where it began is wrong (Kalal 2010)
RANSAC_PX = 2.5  # 0.4 m at 100 m: what stands above the ground is left out
MIN_INLIERS = 20
MIN_INLIER_SHARE = 0.35
MIN_SPREAD = 0.12  # inliers must span this share of the image's width and height, else the pose is not determined
MIN_INLIERS_FEATURES = 15  # chance gives 4 to 8 of 100 wrong matches
MIN_INLIER_SHARE_FEATURES = 0.15
KEYFRAME_SHIFT = 0.22  # of the image width: the next keyframe is due while three quarters are still shared
KEYFRAME_TRACKED = 0.45  # share of the keyframe's corners still tracked
KEYFRAME_MAX_AGE = 10  # frames; half the estimator's window, so that the keyframe is still in it
MAX_MISSES = 5  # frames that may fail against one keyframe before a new fragment starts (PB-5)
MAX_PAIRS = 48
SIGMA_PX = (
    0.75  # of a matched coordinate: tracks slip when the picture turns or the exposure steps (measured 0.4 to 0.9)
)
MAX_TRIPLES, MIN_TRIPLES = 96, 12
REALIGNED_SIGMA_PX = 0.25  # of a coordinate of a corner that a new keyframe found anew (measured 0.13 to 0.6)
SIFT_FEATURES = 1500
SIFT_RATIO = 0.8  # Lowe 2004

_NO_POINTS, _NO_TRIPLES, _NONE = np.zeros((0, 2), np.float32), np.zeros((0, 6)), np.zeros(0, int)


@dataclass
class _Keyframe:
    frame_id: int
    gray: np.ndarray
    corners: np.ndarray  # (N, 2) px
    before: np.ndarray  # (N, 2) px: where these are in the keyframe before; nan: not seen there
    before_id: int  # its frame; meaningless where nothing was seen
    sift: tuple[np.ndarray, np.ndarray] | None = None  # points (N, 2) px, descriptors; made when first needed
    age: int = 0
    registered: bool = False  # it was registered to an earlier keyframe, or a later frame was registered to it


@dataclass(frozen=True)
class Motion:
    """Matches of a frame with its keyframe; ``pairs`` (N, 4) normalised (x_kf, y_kf, x, y).

    ``triples`` (N, 6) normalised (x_before, y_before, x_kf, y_kf, x, y): corners that the keyframe before, frame
    ``before_id``, saw as well. Only of a frame that becomes a keyframe."""

    keyframe_id: int
    verdict: Verdict
    pairs: np.ndarray
    sigma_norm: float
    inliers: int
    tracked: int
    becomes_keyframe: bool
    before_id: int = -1
    triples: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    triples_sigma_norm: float = 0.0


class FrameTracker:
    """Feed frames in order; keeps one keyframe and the last tracked frame."""

    def __init__(self, camera: CameraCalibration) -> None:
        self._scale = min(1.0, WORK_WIDTH_PX / camera.width)
        self._camera = camera.scaled(self._scale)
        self._keyframe: _Keyframe | None = None
        self._last_gray: np.ndarray | None = None  # newest frame that was tracked
        self._last_points = np.zeros((0, 2), np.float32)  # where the keyframe's corners are in it
        self._last_index = np.zeros(0, int)  # which corners these are
        self._misses = 0
        self._missed: _Keyframe | None = None  # the frame that failed last: the first of a new fragment, perhaps
        self._before_fragment: _Keyframe | None = None  # last keyframe of the fragment before this one
        self._sift = cv2.SIFT.create(nfeatures=SIFT_FEATURES, enable_precise_upscale=True)

    def working_copy(self, image: Image) -> np.ndarray:
        """The picture that is tracked: (H, W) gray, at most WORK_WIDTH_PX wide."""
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        if self._scale < 1.0:
            gray = cv2.resize(gray, (self._camera.width, self._camera.height), interpolation=cv2.INTER_AREA)
        return gray

    def track(self, frame_id: int, image: Image) -> Motion:
        return self.register(frame_id, self.working_copy(image))

    def register(self, frame_id: int, gray: np.ndarray) -> Motion:
        """``gray``: the ``working_copy`` of the next frame."""
        keyframe = self._keyframe
        if keyframe is None:
            return self._new_fragment(frame_id, gray)
        keyframe.age += 1
        index, points, tracked = self._follow(keyframe, gray)
        if self._good(keyframe.corners[index], points, tracked, MIN_INLIERS, MIN_INLIER_SHARE):
            return self._accept_tracks(keyframe, frame_id, gray, index, points, tracked)
        # By features: against the keyframe, against the last keyframe of the fragment before (foreign frames end, and
        # the flight goes on where it was), and against the frame that failed before this one: two that agree with each
        # other are a new fragment, one that agrees with nobody is a foreign frame.
        here = _Keyframe(frame_id, gray, _NO_POINTS, _NO_POINTS, -1, self._describe(gray))
        for candidate in (keyframe, self._before_fragment, self._missed):
            if candidate is None:
                continue
            points_kf, points = self._match_features(candidate, here)
            inlier, matched = _homography_inliers(points_kf, points), len(points)
            points_kf, points = points_kf[inlier], points[inlier]
            if self._good(points_kf, points, matched, MIN_INLIERS_FEATURES, MIN_INLIER_SHARE_FEATURES):
                if candidate is self._missed:
                    self._leave_fragment()
                elif candidate is self._before_fragment:
                    self._before_fragment = None
                # The KLT chain is broken; it starts again from this frame.
                self._start_keyframe(frame_id, gray)
                return self._said(candidate, points_kf, points, len(points), matched, due=True)
        return self._miss(keyframe, here, tracked)

    def _follow(self, keyframe: _Keyframe, gray: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """KLT from the last tracked frame. -> which of the keyframe's corners (N,) one homography holds together, where
        they are here (N, 2), and how many were tracked."""
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
        here, index = ahead.reshape(-1, 2)[keep], self._last_index[keep]
        inlier = _homography_inliers(keyframe.corners[index], here)
        if inlier.sum() >= MIN_INLIERS:
            self._last_points, self._last_index, self._last_gray = here[inlier], index[inlier], gray
        return index[inlier], here[inlier], int(keep.sum())

    def _match_features(self, keyframe: _Keyframe, here: _Keyframe) -> tuple[np.ndarray, np.ndarray]:
        """SIFT: large steps and turns between frames. -> points in the keyframe, points here."""
        if keyframe.sift is None:
            keyframe.sift = self._describe(keyframe.gray)
        (points_kf, descriptors_kf), (points, descriptors) = keyframe.sift, here.sift or self._describe(here.gray)
        if len(points_kf) < 2 or len(points) < 2:
            return _NO_POINTS, _NO_POINTS
        pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(descriptors_kf, descriptors, k=2)
        good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < SIFT_RATIO * p[1].distance]
        if not good:
            return _NO_POINTS, _NO_POINTS
        return points_kf[[m.queryIdx for m in good]], points[[m.trainIdx for m in good]]

    def _describe(self, gray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        keypoints, descriptors = self._sift.detectAndCompute(gray, None)
        if descriptors is None:
            return _NO_POINTS, np.zeros((0, 128), np.float32)
        return np.array([k.pt for k in keypoints], np.float32), descriptors

    def _good(self, a: np.ndarray, b: np.ndarray, of: int, at_least: int, share: float) -> bool:
        """The matches (N, 2), (N, 2) that agree, of so many, determine a motion."""
        return len(a) >= at_least and len(a) >= share * of and self._spans(a) and self._spans(b)

    def _spans(self, points: np.ndarray) -> bool:
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
        """``points`` (N, 2): where the corners ``index`` (N,) of the keyframe were tracked to."""
        corners = keyframe.corners[index]
        shift = float(np.median(np.linalg.norm(corners - points, axis=1))) / self._camera.width
        due = (
            shift > KEYFRAME_SHIFT
            or len(index) < KEYFRAME_TRACKED * max(len(keyframe.corners), 1)
            or keyframe.age >= KEYFRAME_MAX_AGE
        )
        here, kept = realigned(keyframe.gray, corners, gray, points, RANSAC_PX)
        triples = _NO_TRIPLES
        if due:
            triples = self._triples(keyframe, here, index[kept])
            self._start_keyframe(frame_id, gray, here, corners[kept], keyframe.frame_id)
        # A blurred picture lies on no patch; its tracks are there all the same.
        if len(kept) < MIN_INLIERS or not self._spans(here):
            here, kept = points, np.arange(len(points))
        return self._said(keyframe, corners[kept], here, len(index), tracked, due=due, triples=triples)

    def _triples(self, keyframe: _Keyframe, here: np.ndarray, index: np.ndarray) -> np.ndarray:
        three = np.isfinite(keyframe.before[index, 0])
        if three.sum() < MIN_TRIPLES:
            return _NO_TRIPLES
        here, index = here[three], index[three]
        pick = _spread(keyframe.corners[index], MAX_TRIPLES)
        views = keyframe.before[index[pick]], keyframe.corners[index[pick]], here[pick]
        return np.hstack([self._camera.normalise(px) for px in views])

    def _said(
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
        """The motion that the matches (N, 2), (N, 2) tell, ``inliers`` of ``tracked`` of which agree."""
        self._misses, self._missed = 0, None
        if self._keyframe is not None:
            self._keyframe.registered = True
        pick = _spread(a, MAX_PAIRS)
        return Motion(
            keyframe.frame_id,
            Verdict.ACCEPTED,
            np.hstack([self._camera.normalise(a[pick]), self._camera.normalise(b[pick])]),
            # A consensus that few of the matches share may be a roof instead of the ground: less is claimed for it.
            SIGMA_PX / self._camera.fx / float(np.sqrt(inliers / tracked)),
            inliers,
            tracked,
            due,
            keyframe.before_id if len(triples) else -1,
            triples,
            REALIGNED_SIGMA_PX / self._camera.fx,
        )

    def _miss(self, keyframe: _Keyframe, here: _Keyframe, tracked: int) -> Motion:
        self._misses += 1
        if self._misses >= MAX_MISSES or keyframe.age >= KEYFRAME_MAX_AGE:
            return self._new_fragment(here.frame_id, here.gray)
        self._missed = here
        return Motion(keyframe.frame_id, Verdict.FEW_INLIERS, np.zeros((0, 4)), 0.0, 0, tracked, False)

    def _leave_fragment(self) -> None:
        """The next frames are a new fragment. A keyframe that no other frame agreed with is no place to return to."""
        if self._keyframe is not None and self._keyframe.registered:
            self._before_fragment = self._keyframe

    def _new_fragment(self, frame_id: int, gray: np.ndarray) -> Motion:
        """The frame stands alone: no motion is known, later frames refer to it."""
        self._leave_fragment()
        self._start_keyframe(frame_id, gray)
        self._misses, self._missed = 0, None
        return Motion(frame_id, Verdict.ACCEPTED, np.zeros((0, 4)), 0.0, 0, 0, True)

    def _start_keyframe(
        self,
        frame_id: int,
        gray: np.ndarray,
        kept: np.ndarray = _NO_POINTS,
        before: np.ndarray = _NO_POINTS,
        before_id: int = -1,
    ) -> None:
        """Corners that are ``kept`` (N, 2) live on, and were seen at ``before`` (N, 2); new ones fill what is empty."""
        empty = np.full(gray.shape, 255, np.uint8)
        for x, y in np.round(kept).astype(int):
            cv2.circle(empty, (int(x), int(y)), MIN_CORNER_DISTANCE_PX, 0, -1)
        wanted = MAX_CORNERS - len(kept)
        corners = cv2.goodFeaturesToTrack(gray, wanted, 0.005, MIN_CORNER_DISTANCE_PX, mask=empty) if wanted else None
        new = corners.reshape(-1, 2).astype(np.float32) if corners is not None else _NO_POINTS
        found = np.vstack([kept, new])
        unseen = np.full((len(new), 2), np.nan, np.float32)
        self._keyframe = _Keyframe(frame_id, gray, found, np.vstack([before, unseen]), before_id)
        self._last_gray, self._last_points, self._last_index = gray, found, np.arange(len(found))


def _homography_inliers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Which of the matches (N, 2), (N, 2) one homography explains: (N,) bool."""
    if len(a) < 8:
        return np.zeros(len(a), bool)
    _, mask = cv2.findHomography(a, b, cv2.RANSAC, RANSAC_PX, maxIters=1500, confidence=0.999)
    return np.zeros(len(a), bool) if mask is None else mask.ravel().astype(bool)


def _spread(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, round-robin over an 8 x 6 grid, so that no corner of the image wins."""
    if len(points) <= limit:
        return np.arange(len(points))
    low, span = points.min(0), np.maximum(np.ptp(points, axis=0), 1.0)
    cell = np.minimum((points - low) / span * (8, 6), (7, 5)).astype(int)
    key = cell[:, 1] * 8 + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[True, np.diff(key[order]) > 0]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    return np.sort(order[np.argsort(rank, kind="stable")[:limit]])
