"""Odometry as vision would say it: tracks of points on relief, houses and trees, through the real camera model.

What `vision/feature_tracker.py` does to pictures is done to points: keyframes, spread, and the same RANSAC homography
with the same thresholds, so that what stands above the ground is let in and left out as it is in flight. The pixel
noise makes the tracks scatter about their homography as those of the real flights do (docs/monte-carlo.md)."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.messages import Odometry, Verdict
from terrafix.vision import feature_tracker as real
from terrafix_tools.montecarlo.flown import Shot
from terrafix_tools.montecarlo.ground import Terrain
from terrafix_tools.montecarlo.lens import Lens

WHITE_PX = 0.30  # of a tracked coordinate in one frame
SLIP_PX = 0.35  # ... and what a track slips, per root of a frame: it is followed from frame to frame
LOST_SHARE = 0.04  # of the tracks, in a frame
GROSS_SHARE, GROSS_PX = 0.04, 25.0  # tracks that jumped to something else
MISS_SHARE = 0.02  # frames that cannot be tracked: exposure, blur
CANDIDATES = 900  # points of the ground among which the corners are
# Of a coordinate of a corner that a new keyframe finds anew: median of the 1-sigma, and spread of its logarithm from
# keyframe to keyframe; and the share of corners that find something else near by.
REALIGNED_PX, REALIGNED_SPREAD, MISALIGNED_SHARE = 0.22, 0.45, 0.08


@dataclass
class _Keyframe:
    frame_id: int
    points_m: np.ndarray  # (N, 3)
    px: np.ndarray  # (N, 2)
    slip_px: np.ndarray  # (N, 2)
    alive: np.ndarray  # (N,) bool
    off_px: np.ndarray  # (N, 2): by what a corner is no longer on the point that it was on at first
    before_px: np.ndarray  # (N, 2), in the keyframe before; nan: not seen there
    before_id: int
    age: int = 0


class Sightings:
    """``see`` once for every frame, in order."""

    def __init__(self, lens: Lens, terrain: Terrain, seed: int) -> None:
        self._lens = lens.scaled(min(1.0, real.WORK_WIDTH_PX / lens.described.width))
        self._camera = self._lens.described
        self._terrain = terrain
        self._rng = np.random.default_rng([seed, 55])
        self._keyframe: _Keyframe | None = None
        self._misses = 0

    def see(self, frame_id: int, shot: Shot, *, blind: bool = False) -> Odometry:
        t_ns = round(shot.t_s * 1e9)
        keyframe = self._keyframe
        if keyframe is None:
            return self._fragment(frame_id, t_ns, shot, blind)
        keyframe.age += 1
        missed = blind or bool(self._rng.uniform() < MISS_SHARE)
        seen = None if missed else self._tracked(keyframe, shot)
        if seen is None:
            self._misses += 1
            if self._misses >= real.MAX_MISSES or keyframe.age >= real.KEYFRAME_MAX_AGE:
                return self._fragment(frame_id, t_ns, shot, blind)
            return Odometry(t_ns=t_ns, frame_id=frame_id, keyframe_id=keyframe.frame_id, verdict=Verdict.FEW_INLIERS)
        a, b, tracked = seen
        self._misses = 0
        shift = float(np.median(np.linalg.norm(a - b, axis=1))) / self._camera.width
        due = (
            shift > real.KEYFRAME_SHIFT
            or len(a) < real.KEYFRAME_TRACKED * len(keyframe.px)
            or keyframe.age >= real.KEYFRAME_MAX_AGE
        )
        pick = np.linspace(0, len(a) - 1, min(len(a), real.MAX_PAIRS)).astype(int)
        pairs = np.hstack([self._camera.normalise(a[pick]), self._camera.normalise(b[pick])])
        triples = np.zeros((0, 6))
        if due:
            self._keyframe, triples = self._next(keyframe, frame_id, shot)
        return Odometry(
            t_ns=t_ns,
            frame_id=frame_id,
            keyframe_id=keyframe.frame_id,
            verdict=Verdict.ACCEPTED,
            pairs=[(float(p), float(q), float(r), float(s)) for p, q, r, s in pairs],
            sigma_norm=real.SIGMA_PX / self._camera.fx / float(np.sqrt(len(a) / tracked)),
            inliers=len(a),
            tracked=tracked,
            becomes_keyframe=due,
            before_id=keyframe.before_id if len(triples) else -1,
            triples=[(float(p), float(q), float(r), float(s), float(t), float(u)) for p, q, r, s, t, u in triples],
            triples_sigma_norm=real.REALIGNED_SIGMA_PX / self._camera.fx,
        )

    def _next(self, keyframe: _Keyframe, frame_id: int, shot: Shot) -> tuple[_Keyframe, np.ndarray]:
        """The keyframe that follows, and what three saw: corners that are still tracked live on."""
        kept = np.flatnonzero(keyframe.alive)
        sigma_px = REALIGNED_PX * float(np.exp(REALIGNED_SPREAD * self._rng.normal()))
        off = keyframe.off_px[kept] + sigma_px * self._rng.normal(size=(len(kept), 2))
        wrong = self._rng.uniform(size=len(kept)) < MISALIGNED_SHARE
        off[wrong] += real.RANSAC_PX * self._rng.uniform(-0.7, 0.7, (int(wrong.sum()), 2))
        px, inside = self._projected(keyframe.points_m[kept], shot)
        kept, off, px = kept[inside], off[inside], (px + off)[inside]
        new = self._new(frame_id, shot)
        fresh = slice(0, real.MAX_CORNERS - len(kept))
        following = _Keyframe(
            frame_id,
            np.vstack([keyframe.points_m[kept], new.points_m[fresh]]),
            np.vstack([px, new.px[fresh]]),
            np.zeros((len(px) + len(new.px[fresh]), 2)),
            np.ones(len(px) + len(new.px[fresh]), bool),
            np.vstack([off, new.off_px[fresh]]),
            np.vstack([keyframe.px[kept], new.before_px[fresh]]),
            keyframe.frame_id,
        )
        three = np.flatnonzero(np.isfinite(keyframe.before_px[kept, 0]))
        if len(three) < real.MIN_TRIPLES:
            return following, np.zeros((0, 6))
        pick = three[np.linspace(0, len(three) - 1, min(len(three), real.MAX_TRIPLES)).astype(int)]
        views = keyframe.before_px[kept[pick]], keyframe.px[kept[pick]], px[pick]
        return following, np.hstack([self._camera.normalise(view) for view in views])

    def _tracked(self, keyframe: _Keyframe, shot: Shot) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Inliers in keyframe and frame (px), and how many were tracked; None: too few."""
        px, inside = self._projected(keyframe.points_m, shot)
        rng, n = self._rng, len(px)
        keyframe.slip_px += SLIP_PX * rng.normal(size=(n, 2))
        keyframe.alive &= inside & (rng.uniform(size=n) > LOST_SHARE)
        noise = WHITE_PX * rng.normal(size=(n, 2))
        gross = rng.uniform(size=n) < GROSS_SHARE
        noise[gross] += GROSS_PX * rng.uniform(-1.0, 1.0, (int(gross.sum()), 2))
        a, b = keyframe.px[keyframe.alive], (px + keyframe.off_px + keyframe.slip_px + noise)[keyframe.alive]
        if len(a) < real.MIN_INLIERS:
            return None
        _, mask = cv2.findHomography(a, b, cv2.RANSAC, real.RANSAC_PX, maxIters=1500, confidence=0.999)
        inlier = np.zeros(len(a), bool) if mask is None else mask.ravel().astype(bool)
        if inlier.sum() < real.MIN_INLIERS or inlier.mean() < real.MIN_INLIER_SHARE:
            return None
        keyframe.alive[np.flatnonzero(keyframe.alive)[~inlier]] = False  # a track that left is not followed on
        return a[inlier], b[inlier], len(a)

    def _fragment(self, frame_id: int, t_ns: int, shot: Shot, blind: bool) -> Odometry:
        """The frame stands alone."""
        self._keyframe, self._misses = self._new(frame_id, shot, blind=blind), 0
        return Odometry(
            t_ns=t_ns, frame_id=frame_id, keyframe_id=frame_id, verdict=Verdict.ACCEPTED, becomes_keyframe=True
        )

    def _new(self, frame_id: int, shot: Shot, *, blind: bool = False) -> _Keyframe:
        """Corners anywhere in the picture: on the ground, on roofs, in crowns."""
        corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * (self._camera.width, self._camera.height)
        rays = self._lens.rays(corners) @ shot.r_w_c.T
        ground_m = self._terrain.bare_at_m(float(shot.p_m[0]), float(shot.p_m[1]))
        reach = (shot.p_m[2] - ground_m) / np.maximum(-rays[:, 2], 0.2)
        box = shot.p_m[:2] + rays[:, :2] * reach[:, None]
        places = self._rng.uniform(box.min(0), box.max(0), (CANDIDATES, 2))
        up = self._terrain.bare_m(places) + self._terrain.standing_m(places)
        points = np.column_stack([places, up])
        px, inside = self._projected(points, shot)
        chosen = np.flatnonzero(inside)[: 0 if blind else real.MAX_CORNERS]
        none = np.zeros((len(chosen), 2))
        return _Keyframe(
            frame_id, points[chosen], px[chosen], none, np.ones(len(chosen), bool), none.copy(), none + np.nan, -1
        )

    def _projected(self, points_m: np.ndarray, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
        """-> pixels (N, 2) of the working picture, and which of them lie in it."""
        in_c = (points_m - shot.p_m) @ shot.r_w_c
        ahead = in_c[:, 2] > 1.0
        px = self._lens.project(np.where(ahead[:, None], in_c, (0.0, 0.0, 1.0)))
        return px, ahead & ((px > 0.0) & (px < (self._camera.width, self._camera.height))).all(axis=1)
