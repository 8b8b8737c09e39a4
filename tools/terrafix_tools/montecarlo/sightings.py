"""Odometry as vision would say it: tracks of points on relief, houses and trees, through the real camera model.

What `vision/odometry.py` does to pictures is done to points: keyframes, spread, and the same RANSAC homography with the
same thresholds, so that what stands above the ground is let in and left out as it is in flight. The pixel noise makes
the tracks scatter about their homography as those of the real flights do (docs/monte-carlo.md)."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.messages import Odometry, Verdict
from terrafix.vision import odometry as real
from terrafix_tools.montecarlo.flown import Shot
from terrafix_tools.montecarlo.ground import Terrain
from terrafix_tools.montecarlo.lens import Lens

WHITE_PX = 0.30  # of a tracked coordinate in one frame
SLIP_PX = 0.35  # ... and what a track slips, per root of a frame: it is followed from frame to frame
LOST_SHARE = 0.04  # of the tracks, in a frame
GROSS_SHARE, GROSS_PX = 0.04, 25.0  # tracks that jumped to something else
MISS_SHARE = 0.02  # frames that cannot be tracked: exposure, blur
CANDIDATES = 900  # points of the ground among which the corners are


@dataclass
class _Keyframe:
    frame_id: int
    points_m: np.ndarray  # (N, 3)
    px: np.ndarray  # (N, 2)
    slip_px: np.ndarray  # (N, 2)
    alive: np.ndarray  # (N,) bool
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
        if due:
            self._keyframe = self._new(frame_id, shot)
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
        )

    def _tracked(self, keyframe: _Keyframe, shot: Shot) -> tuple[np.ndarray, np.ndarray, int] | None:
        """Inliers in keyframe and frame (px), and how many were tracked; None: too few."""
        px, inside = self._projected(keyframe.points_m, shot)
        rng, n = self._rng, len(px)
        keyframe.slip_px += SLIP_PX * rng.normal(size=(n, 2))
        keyframe.alive &= inside & (rng.uniform(size=n) > LOST_SHARE)
        noise = WHITE_PX * rng.normal(size=(n, 2))
        gross = rng.uniform(size=n) < GROSS_SHARE
        noise[gross] += GROSS_PX * rng.uniform(-1.0, 1.0, (int(gross.sum()), 2))
        a, b = keyframe.px[keyframe.alive], (px + keyframe.slip_px + noise)[keyframe.alive]
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
        slip = np.zeros((len(chosen), 2))
        return _Keyframe(frame_id, points[chosen], px[chosen], slip, np.ones(len(chosen), bool))

    def _projected(self, points_m: np.ndarray, shot: Shot) -> tuple[np.ndarray, np.ndarray]:
        """-> pixels (N, 2) of the working picture, and which of them lie in it."""
        in_c = (points_m - shot.p_m) @ shot.r_w_c
        ahead = in_c[:, 2] > 1.0
        px = self._lens.project(np.where(ahead[:, None], in_c, (0.0, 0.0, 1.0)))
        return px, ahead & ((px > 0.0) & (px < (self._camera.width, self._camera.height))).all(axis=1)
