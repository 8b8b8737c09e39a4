"""Relief of the ground, and its first intersection with rays."""

import math

import numpy as np

from terrafix_lab.sim.ground.warp import Warp

VIEW_M = 12_000.0  # range of view; beyond it only air is visible
STEP_POSTS = 0.5  # step of the ray marching, in posts of the elevation model
STEP_SHARE = 0.01  # or this share of the distance if larger: narrower features cover few pixels there
MAX_STEPS = 1500  # steps towards the sun
REFINE_STEPS = 4  # false position steps after the march
MIN_DESCENT = 1e-3  # sine below the horizon: flatter rays meet no ground within VIEW_M


class Relief:
    """Elevation posts (h, w) float32, metres AMSL, bilinear in between; constant beyond the edge."""

    def __init__(self, amsl_m: np.ndarray, px_from_local: Warp) -> None:
        self._amsl_m = np.ascontiguousarray(amsl_m, np.float32)
        self._warp = px_from_local
        x, y = px_from_local(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
        px_per_m = math.sqrt(abs((x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])))
        self.post_m = 1.0 / px_per_m
        self.lowest_m, self.highest_m = float(amsl_m.min()), float(amsl_m.max())

    def height_amsl_m(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        """Ground height at local points of any shape: float64 of that shape."""
        x, y = self._warp(e_m, n_m)
        rows, columns = self._amsl_m.shape
        x, y = np.clip(x, 0.0, columns - 1.0), np.clip(y, 0.0, rows - 1.0)
        i, j = np.minimum(x.astype(np.intp), columns - 2), np.minimum(y.astype(np.intp), rows - 2)
        u, v = x - i, y - j
        posts, at = self._amsl_m.ravel(), j * columns + i
        upper = posts[at] * (1.0 - u) + posts[at + 1] * u
        lower = posts[at + columns] * (1.0 - u) + posts[at + columns + 1] * u
        return upper * (1.0 - v) + lower * v

    def slope(self, e_m: np.ndarray, n_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Slope to the east and to the north (m/m), over one post."""
        half = self.post_m / 2
        east = self.height_amsl_m(e_m + half, n_m) - self.height_amsl_m(e_m - half, n_m)
        north = self.height_amsl_m(e_m, n_m + half) - self.height_amsl_m(e_m, n_m - half)
        return east / self.post_m, north / self.post_m

    def max_slope(self, e_m: np.ndarray, n_m: np.ndarray) -> float:
        """Largest slope between neighbouring posts in the bounding box of local points."""
        part = self._posts(e_m, n_m)
        rise = max(float(np.abs(np.diff(part, axis=a)).max()) if part.shape[a] > 1 else 0.0 for a in (0, 1))
        return math.sqrt(2.0) * rise / self.post_m

    def _posts(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        """Posts in the bounding box of local points, and the next ones outside it."""
        x, y = self._warp(np.array([e_m.min(), e_m.min(), e_m.max(), e_m.max()]), np.array([n_m.min(), n_m.max()] * 2))
        rows, columns = self._amsl_m.shape
        x0, x1 = (int(v) for v in np.clip([x.min() - 1, x.max() + 2], 0, columns - 1))
        y0, y1 = (int(v) for v in np.clip([y.min() - 1, y.max() + 2], 0, rows - 1))
        return self._amsl_m[y0 : max(y1, y0 + 1) + 1, x0 : max(x1, x0 + 1) + 1]

    def shaded(self, points_m: np.ndarray, sun_enu: np.ndarray) -> np.ndarray:
        """Whether hills are between ground points (..., 3) and the sun (unit vector): bool (...)."""
        climb = sun_enu[2] / max(float(np.hypot(sun_enu[0], sun_enu[1])), 1e-6)  # metres up per horizontal metre
        max_m = (self.highest_m - points_m[..., 2].min()) / climb
        shaded = np.zeros(points_m.shape[:-1], bool)
        for along_m in np.arange(1.0, min(max_m / self.post_m, MAX_STEPS) + 1.0) * self.post_m:
            at = points_m + sun_enu * (along_m * climb / sun_enu[2])
            shaded |= self.height_amsl_m(at[..., 0], at[..., 1]) > at[..., 2]
        return shaded

    def intersect(
        self,
        from_m: np.ndarray,
        rays: np.ndarray,
        after_m: np.ndarray | float = 0.0,
        before_m: np.ndarray | float = VIEW_M,
    ) -> np.ndarray:
        """Distance (N,) along unit rays (N, 3) from points (N, 3) above the ground to the ground; inf: none within the
        limits.

        ``after_m``, ``before_m`` (N,): limits along the rays. The rays march in steps of half a post, from the height
        of the highest post below them, and the hit is refined by false position.
        """
        out = np.full(len(rays), math.inf)
        which = np.flatnonzero(rays[:, 2] < -MIN_DESCENT)
        start, ray = from_m[which], rays[which]
        if not len(which):
            return out
        after, before = (np.broadcast_to(v, len(rays))[which] for v in (after_m, before_m))
        far = np.minimum((start[:, 2] - self.lowest_m + 1.0) / -ray[:, 2], before)
        ends = start[:, :2] + ray[:, :2] * far[:, None]
        posts = self._posts(*np.concatenate([start[:, :2], ends]).T)
        near = np.maximum((start[:, 2] - float(posts.max()) - 1.0) / -ray[:, 2], after)
        far = np.minimum((start[:, 2] - float(posts.min()) + 1.0) / -ray[:, 2], far)
        step_m = STEP_POSTS * self.post_m / np.maximum(np.hypot(ray[:, 0], ray[:, 1]), 1e-9)
        above = self._above(start, ray, near)
        while len(which):
            beyond = np.minimum(near + np.maximum(step_m, STEP_SHARE * near), far)
            above_beyond = self._above(start, ray, beyond)
            hit = above_beyond <= 0.0
            out[which[hit]] = self._refine(start[hit], ray[hit], near[hit], beyond[hit], above[hit], above_beyond[hit])
            continuing = ~hit & (beyond < far)
            which, start, ray, far, step_m = (
                which[continuing],
                start[continuing],
                ray[continuing],
                far[continuing],
                step_m[continuing],
            )
            near, above = beyond[continuing], above_beyond[continuing]
        return out

    def _above(self, start: np.ndarray, ray: np.ndarray, at_m: np.ndarray) -> np.ndarray:
        """Height above the ground of the points at ``at_m`` along rays."""
        points = start + ray * at_m[:, None]
        return points[:, 2] - self.height_amsl_m(points[:, 0], points[:, 1])

    def _refine(
        self,
        start: np.ndarray,
        ray: np.ndarray,
        near: np.ndarray,
        far: np.ndarray,
        above_near: np.ndarray,
        above_far: np.ndarray,
    ) -> np.ndarray:
        """False position: the ground between two points half a post apart is nearly planar."""
        for _ in range(REFINE_STEPS):
            share = above_near / np.maximum(above_near - above_far, 1e-9)
            at = near + (far - near) * np.clip(share, 0.0, 1.0)
            above = self._above(start, ray, at)
            under = above <= 0.0
            near, above_near = np.where(under, near, at), np.where(under, above_near, above)
            far, above_far = np.where(under, at, far), np.where(under, above, above_far)
        return at
