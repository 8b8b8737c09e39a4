"""Odometry as vision publishes it: tracks of points on relief, houses and trees, through the true camera model.

The steps of `vision/feature_tracker.py` are applied to points: keyframes, selection, and the same RANSAC homography
with the same thresholds, so that points above the ground become inliers as often as in flight. With this pixel noise
the tracks scatter about their homography as those of the real flights do (docs/monte-carlo.md)."""

from dataclasses import dataclass

import msgspec
import numpy as np

from terrafix.core.limits import MAX_KEYFRAME_AGE
from terrafix.messages import Odometry, Verdict
from terrafix.vision import feature_tracker as real
from terrafix.vision import repeated_picture
from terrafix.vision.two_view import RANSAC_PX, homography_inliers
from terrafix_lab.montecarlo.flown import Shot
from terrafix_lab.montecarlo.ground import Terrain
from terrafix_lab.montecarlo.lens import TrueLens
from terrafix_lab.sim.true_messages import first_odometry

WHITE_PX = 0.30  # 1-sigma of a tracked coordinate in one frame, white
SLIP_PX = 0.35  # ... and random walk of a track per root of a frame
LOST_SHARE = 0.04  # of the tracks, lost per frame
GROSS_SHARE, GROSS_PX = 0.04, 25.0  # share of gross outliers, and their size
MISS_SHARE = 0.02  # frames without tracking: exposure, blur
CANDIDATES = 900  # random points from which the corners are chosen
# Realignment of a corner in a new keyframe: median of the 1-sigma of a coordinate, spread of its logarithm between
# keyframes, and share of the corners that are aligned to something else near by.
REALIGNED_PX, REALIGNED_SPREAD, MISALIGNED_SHARE = 0.22, 0.45, 0.08


@dataclass
class _Keyframe:
    frame_id: int
    points_m: np.ndarray  # (N, 3)
    px: np.ndarray  # (N, 2)
    slip_px: np.ndarray  # (N, 2) accumulated random walk
    tracked: np.ndarray  # (N,) bool
    off_px: np.ndarray  # (N, 2): accumulated realignment error of a corner
    before_px: np.ndarray  # (N, 2), in the keyframe before; nan: not tracked there
    previous_keyframe_id: int
    age: int = 0


class SimulatedOdometry:
    """Call ``odometry`` once for every frame, in order."""

    def __init__(self, lens: TrueLens, terrain: Terrain, seed: int) -> None:
        self._lens = lens.scaled(min(1.0, real.WORK_WIDTH_PX / lens.described.width))
        self._camera = self._lens.described
        self._terrain = terrain
        self._rng = np.random.default_rng([seed, 55])
        self._keyframe: _Keyframe | None = None
        self._misses = 0
        self._fragment_id = -1  # of the keyframe
        self._before: Shot | None = None  # of the frame before

    def odometry(self, frame_id: int, shot: Shot, *, blind: bool = False) -> Odometry:
        before, self._before = self._before, shot
        odometry = self._registered(frame_id, shot, blind)
        if blind or before is None or not self._is_same_view(before, shot):
            return odometry
        return msgspec.structs.replace(odometry, static=True)

    def _is_same_view(self, before: Shot, shot: Shot) -> bool:
        """Whether vision/repeated_picture.py finds no displacement between two pictures, whatever their noise."""
        size = np.array([self._camera.width, self._camera.height])
        quadrants = np.array([[0.25, 0.25], [0.75, 0.25], [0.75, 0.75], [0.25, 0.75]]) * size
        points_m = self._on_level_ground(quadrants, before)
        shift_px = np.hypot(*(self._projected(points_m, shot)[0] - self._projected(points_m, before)[0]).T)
        scale = repeated_picture.WIDTH_PX / self._camera.width
        return bool((scale * shift_px <= repeated_picture.MAX_SHIFT_PX).all())

    def _registered(self, frame_id: int, shot: Shot, blind: bool) -> Odometry:
        t_ns = round(shot.t_s * 1e9)
        keyframe = self._keyframe
        if keyframe is None:
            return self._new_fragment(frame_id, t_ns, shot, blind)
        keyframe.age += 1
        missed = blind or bool(self._rng.uniform() < MISS_SHARE)
        inliers = None if missed else self._tracked(keyframe, shot)
        if inliers is None:
            self._misses += 1
            if self._misses >= real.MAX_TRACK_FAILURES or keyframe.age >= MAX_KEYFRAME_AGE:
                return self._new_fragment(frame_id, t_ns, shot, blind)
            return Odometry(t_ns=t_ns, frame_id=frame_id, keyframe_id=keyframe.frame_id, verdict=Verdict.FEW_INLIERS)
        a, b, tracked = inliers
        self._misses = 0
        shift = float(np.median(np.linalg.norm(a - b, axis=1))) / self._camera.width
        due = (
            shift > real.KEYFRAME_SHIFT
            or len(a) < real.KEYFRAME_TRACKED * len(keyframe.px)
            or keyframe.age >= MAX_KEYFRAME_AGE
        )
        pick = np.linspace(0, len(a) - 1, min(len(a), real.MAX_ODOMETRY_PAIRS)).astype(int)
        pairs = np.hstack([self._camera.normalise(a[pick]), self._camera.normalise(b[pick])])
        triples = np.zeros((0, 6))
        if due:
            self._keyframe, triples = self._next_keyframe(keyframe, frame_id, shot)
        return Odometry(
            t_ns=t_ns,
            frame_id=frame_id,
            keyframe_id=keyframe.frame_id,
            verdict=Verdict.ACCEPTED,
            two_view=[(float(p), float(q), float(r), float(s)) for p, q, r, s in pairs],
            sigma_norm=real.SIGMA_PX / self._camera.fx / float(np.sqrt(len(a) / tracked)),
            inliers=len(a),
            tracked=tracked,
            becomes_keyframe=due,
            previous_keyframe_id=keyframe.previous_keyframe_id if len(triples) else -1,
            three_view=[(float(p), float(q), float(r), float(s), float(t), float(u)) for p, q, r, s, t, u in triples],
            three_view_sigma_norm=real.ALIGNED_SIGMA_PX / self._camera.fx,
            fragment_id=self._fragment_id,
        )

    def _next_keyframe(self, keyframe: _Keyframe, frame_id: int, shot: Shot) -> tuple[_Keyframe, np.ndarray]:
        """The next keyframe, which continues the tracked corners, and the points (N, 6) of three keyframes."""
        indices = np.flatnonzero(keyframe.tracked)
        sigma_px = REALIGNED_PX * float(np.exp(REALIGNED_SPREAD * self._rng.normal()))
        off = keyframe.off_px[indices] + sigma_px * self._rng.normal(size=(len(indices), 2))
        wrong = self._rng.uniform(size=len(indices)) < MISALIGNED_SHARE
        off[wrong] += RANSAC_PX * self._rng.uniform(-0.7, 0.7, (int(wrong.sum()), 2))
        px, inside = self._projected(keyframe.points_m[indices], shot)
        indices, off, px = indices[inside], off[inside], (px + off)[inside]
        new = self._new_keyframe(frame_id, shot)
        fresh = slice(0, real.MAX_CORNERS - len(indices))
        following = _Keyframe(
            frame_id,
            np.vstack([keyframe.points_m[indices], new.points_m[fresh]]),
            np.vstack([px, new.px[fresh]]),
            np.zeros((len(px) + len(new.px[fresh]), 2)),
            np.ones(len(px) + len(new.px[fresh]), bool),
            np.vstack([off, new.off_px[fresh]]),
            np.vstack([keyframe.px[indices], new.before_px[fresh]]),
            keyframe.frame_id,
        )
        three = np.flatnonzero(np.isfinite(keyframe.before_px[indices, 0]))
        if len(three) < real.MIN_ODOMETRY_TRIPLES:
            return following, np.zeros((0, 6))
        pick = three[np.linspace(0, len(three) - 1, min(len(three), real.MAX_ODOMETRY_TRIPLES)).astype(int)]
        views = keyframe.before_px[indices[pick]], keyframe.px[indices[pick]], px[pick]
        return following, np.hstack([self._camera.normalise(view) for view in views])

    def _tracked(self, keyframe: _Keyframe, shot: Shot) -> tuple[np.ndarray, np.ndarray, int] | None:
        """-> inliers (N, 2), (N, 2) in keyframe and frame [px], and the number of tracks; None: too few."""
        px, inside = self._projected(keyframe.points_m, shot)
        rng, n = self._rng, len(px)
        keyframe.slip_px += SLIP_PX * rng.normal(size=(n, 2))
        keyframe.tracked &= inside & (rng.uniform(size=n) > LOST_SHARE)
        noise = WHITE_PX * rng.normal(size=(n, 2))
        gross = rng.uniform(size=n) < GROSS_SHARE
        noise[gross] += GROSS_PX * rng.uniform(-1.0, 1.0, (int(gross.sum()), 2))
        a, b = keyframe.px[keyframe.tracked], (px + keyframe.off_px + keyframe.slip_px + noise)[keyframe.tracked]
        if len(a) < real.TRACK_MIN_INLIERS:
            return None
        inlier = homography_inliers(a, b)
        if inlier.sum() < real.TRACK_MIN_INLIERS or inlier.mean() < real.TRACK_MIN_INLIER_RATIO:
            return None
        keyframe.tracked[np.flatnonzero(keyframe.tracked)[~inlier]] = False  # outliers are dropped for good
        return a[inlier], b[inlier], len(a)

    def _new_fragment(self, frame_id: int, t_ns: int, shot: Shot, blind: bool) -> Odometry:
        """The frame is a keyframe without a predecessor."""
        self._keyframe, self._misses = self._new_keyframe(frame_id, shot, blind=blind), 0
        self._fragment_id += 1
        return first_odometry(t_ns, frame_id, self._fragment_id)

    def _new_keyframe(self, frame_id: int, shot: Shot, *, blind: bool = False) -> _Keyframe:
        """A keyframe with random corners on the ground, on roofs and in tree crowns."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * (self._camera.width, self._camera.height)
        box = self._on_level_ground(corners, shot)[:, :2]
        places = self._rng.uniform(box.min(0), box.max(0), (CANDIDATES, 2))
        up = self._terrain.bare_m(places) + self._terrain.standing_m(places)
        points = np.column_stack([places, up])
        px, inside = self._projected(points, shot)
        chosen = np.flatnonzero(inside)[: 0 if blind else real.MAX_CORNERS]
        none = np.zeros((len(chosen), 2))
        return _Keyframe(
            frame_id, points[chosen], px[chosen], none, np.ones(len(chosen), bool), none.copy(), none + np.nan, -1
        )

    def _on_level_ground(self, px: np.ndarray, shot: Shot) -> np.ndarray:
        """(N, 3) where the rays of pixels (N, 2) meet a level plane at the height of the ground below the camera."""
        rays = self._lens.showing(shot.scale).rays(px) @ shot.r_w_c.T
        ground_m = self._terrain.bare_at_m(float(shot.p_m[0]), float(shot.p_m[1]))
        reach = (shot.p_m[2] - ground_m) / np.maximum(-rays[:, 2], 0.2)
        return np.asarray(np.column_stack([shot.p_m[:2] + rays[:, :2] * reach[:, None], np.full(len(px), ground_m)]))

    def _projected(self, points_m: np.ndarray, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
        """-> pixels (N, 2) of the scaled picture, and (N,) which of them lie in it."""
        in_c = (points_m - shot.p_m) @ shot.r_w_c
        ahead = in_c[:, 2] > 1.0
        px = self._lens.showing(shot.scale).project(np.where(ahead[:, None], in_c, (0.0, 0.0, 1.0)))
        return px, ahead & ((px > 0.0) & (px < (self._camera.width, self._camera.height))).all(axis=1)
