"""Renderer: camera images of the ground from rays, relief, light, air and film.

The rays of a coarse pixel grid are intersected with the relief, and the frame is interpolated between them; where a
ridge occludes the ground behind it, every pixel has its own ray. Tests compare it with projections of 3D points that
share no code with it.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix import messages as m
from terrafix_lab.sim.camera.film import Developer, Film
from terrafix_lab.sim.camera.grid import GRID_PX, Dense, Grid, cell_steps, sample_image
from terrafix_lab.sim.camera.lens import Lens, lens_of
from terrafix_lab.sim.camera.mount import CameraMotion
from terrafix_lab.sim.camera.weather import AIR_BGR, CLOUD_BGR, Sky, Weather, blend
from terrafix_lab.sim.ground.detail import DETAIL_M, NEUTRAL, detail
from terrafix_lab.sim.ground.draped_image import Ground, drape, open_ground
from terrafix_lab.sim.ground.relief import VIEW_M

__all__ = ["CameraMotion", "Film", "Ground", "Renderer", "Weather", "drape", "open_ground"]

MAX_SCALE_RATIO = 1.5  # ratio of the coarsest to the finest ground pixel above which the frame is sampled in blocks
BLOCK = 8  # side of a block in grid cells
DETAIL_MAX_STEP_PX = 6.0  # pixels of the fine texture per image pixel above which the texture averages out
DETAIL_WINDOW_PX = 8192  # largest window of the fine texture; a block with more looks at the horizon
OCCLUSION_LIMIT = 0.35  # slope x tangent of the view angle; occlusion occurs from 1 on, visible curvature earlier
DISTANCE_MARGIN = 1.25  # bound on the distance of the ground in a cell relative to its corners and centre
CURVATURE_MAX_DISTANCE_M = 3000.0  # beyond this distance curvature of the ground is not visible
CURVATURE_PX = 1.0  # a cell whose centre deviates by more gets one ray per pixel
FLOW_S = 1e-3  # time step of the flow's difference quotient
FILM, CLEAR = Film(), Weather()
STILL = CameraMotion(np.zeros(3), np.zeros(3))


@dataclass(frozen=True)
class View:
    """One frame on the coarse grid; ``distance_m`` is inf for sky."""

    p_c_in_w_m: np.ndarray  # (3,) at the middle row
    r_w_c: np.ndarray  # (3, 3)
    motion: CameraMotion
    from_m: np.ndarray  # (rows, 1, 3): with a rolling shutter every row has its own camera position
    rays: np.ndarray  # (rows, columns, 3) unit, in w
    distance_m: np.ndarray  # (rows, columns)
    points_m: np.ndarray  # (rows, columns, 3) on the ground; for sky at the end of the view


class Renderer:
    """Renders frames of one camera over one ground. ``frame`` is a function of its arguments and of the seed."""

    def __init__(
        self,
        ground: Ground,
        camera: m.Camera | Lens,
        *,
        film: Film = FILM,
        weather: Weather = CLEAR,
        seed: int = 0,
    ) -> None:
        self._ground, self._film = ground, film
        self._lens: Lens = lens_of(camera) if isinstance(camera, m.Camera) else camera
        self._grid = Grid(self._lens.width, self._lens.height)
        self._rays_in_c = self._lens.rays(self._grid.px).reshape(*self._grid.shape, 3)
        centre = self._lens.project(np.array([[0.0, 0.0, 1.0]]))[0]
        self._developer = Developer(film, self._lens.width, self._lens.height, (centre[0], centre[1]), seed)
        pair = self._lens.rays(np.array([[0.5, 0.0], [-0.5, 0.0]]) + centre)
        self._pixel_rad = float(np.linalg.norm(pair[0] - pair[1]))
        self._sky = Sky(weather, ground.relief, seed)
        self._detail = detail(seed, film.detail) if film.detail else None

    def frame(
        self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray, index: int, *, t_s: float = 0.0, motion: CameraMotion = STILL
    ) -> np.ndarray:
        """Returns image number ``index`` of the flight: (H, W, 3) uint8 BGR. p_c_in_w_m (3,), r_w_c (3, 3).

        ``t_s``: seconds of the flight, for moving clouds. ``motion``: for a film with exposure or readout time; the
        pose is that at the middle row.
        """
        view = self._view(p_c_in_w_m, r_w_c, motion)
        flow = self._flow_px_per_s(view) if self._film.exposure_s and motion is not STILL else None
        return self._developer.develop(self._with_weather(self._scene(view), view, t_s), index, flow)

    def ground_points(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
        """Returns the intersections of the coarse grid's rays with the ground: (rows, columns, 3) east, north, up."""
        return self._view(p_c_in_w_m, r_w_c, STILL).points_m

    def _view(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray, motion: CameraMotion) -> View:
        from_m, rotations = motion.pose(p_c_in_w_m, r_w_c, self._row_times_s(self._grid.row_px))
        rays = np.einsum("rij,rcj->rci", rotations, self._rays_in_c)
        from_m = from_m[:, None, :]
        starts = np.broadcast_to(from_m, rays.shape).reshape(-1, 3)
        distance_m = self._ground.relief.intersect(starts, rays.reshape(-1, 3)).reshape(rays.shape[:2])
        points_m = from_m + rays * np.minimum(distance_m, VIEW_M)[..., None]
        return View(p_c_in_w_m, r_w_c, motion, from_m, rays, distance_m, points_m)

    def _row_times_s(self, row_px: np.ndarray) -> np.ndarray:
        """Readout times of rows, relative to the middle one."""
        return (row_px / (self._lens.height - 1) - 0.5) * self._film.readout_s

    # --- the ground ---

    def _scene(self, view: View) -> np.ndarray:
        """Renders the ground without air: (H, W, 3)."""
        height, width = self._lens.height, self._lens.width
        image = np.empty((height, width, 3), np.uint8)
        image[:] = AIR_BGR
        points = view.points_m
        step_m = cell_steps(points[..., 0], points[..., 1], GRID_PX)
        has_ground = np.isfinite(view.distance_m)
        ground = has_ground[:-1, :-1] & has_ground[1:, :-1] & has_ground[:-1, 1:] & has_ground[1:, 1:]
        if not ground.any():
            return image
        if ground.all() and step_m.max() <= MAX_SCALE_RATIO * step_m.min():
            image = self._sample_ground(points, self._grid.dense)
        else:
            for pixels, at in self._grid.blocks(BLOCK):
                if has_ground[at].any():
                    nearness = 1.0 / np.minimum(view.distance_m[at], VIEW_M)
                    image[pixels] = self._sample_ground(
                        points[at], self._grid.projective(nearness, image[pixels].shape[:2])
                    )
        self._render_curved_cells(image, view, ground)
        if not has_ground.all():
            image[self._grid.dense(~has_ground) > 0.5] = AIR_BGR
        return image

    def _sample_ground(self, points: np.ndarray, dense: Dense, spacing_px: int = GRID_PX) -> np.ndarray:
        """Samples image and fine texture at points on the ground (rows, columns, 3), which ``dense`` interpolates to
        pixels.
        """
        e_m, n_m = points[..., 0], points[..., 1]
        x, y = self._ground.px_from_local(e_m, n_m)
        image = sample_image(self._ground.picture, x, y, float(np.median(cell_steps(x, y, spacing_px))), dense)
        if self._detail is None:
            return image
        x, y = e_m / DETAIL_M, n_m / DETAIL_M
        step_px = float(np.median(cell_steps(x, y, spacing_px)))
        if step_px > DETAIL_MAX_STEP_PX or max(np.ptp(x), np.ptp(y)) > DETAIL_WINDOW_PX:
            return image
        fine = sample_image(self._detail, x, y, step_px, dense)
        return cv2.multiply(image, cv2.merge([fine, fine, fine]), scale=1 / NEUTRAL)

    def _render_curved_cells(self, image: np.ndarray, view: View, ground: np.ndarray) -> None:
        """Renders grid cells again in which the ground is not planar, with one ray per pixel: edges that occlude
        ground.
        """
        points = view.points_m[:-1, :-1][ground]
        level = np.hypot(view.rays[..., 0], view.rays[..., 1])[:-1, :-1][ground]
        tangent = float((level / -view.rays[..., 2][:-1, :-1][ground]).max())
        if self._ground.relief.max_slope(points[:, 0], points[:, 1]) * tangent < OCCLUSION_LIMIT:
            return
        curved, near_m, far_m = self._curved_cells(view, ground)
        if not len(curved):
            return
        tiles = [(slice(j * GRID_PX, (j + 1) * GRID_PX), slice(i * GRID_PX, (i + 1) * GRID_PX)) for j, i in curved]
        inside = np.stack(np.meshgrid(np.arange(GRID_PX), np.arange(GRID_PX)), axis=-1).reshape(-1, 2)
        px = (curved[:, None, ::-1] * GRID_PX + inside).reshape(-1, 2).astype(np.float64)
        ground_points = self._ground_of_pixels(view, px, *(np.repeat(v, GRID_PX**2) for v in (near_m, far_m))).reshape(
            -1, GRID_PX, GRID_PX, 3
        )
        for tile, at in zip(tiles, ground_points, strict=True):
            part = image[tile]
            part[:] = self._sample_ground(at, lambda v: v.astype(np.float32), 1)[: part.shape[0], : part.shape[1]]

    def _curved_cells(self, view: View, ground: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns cells (M, 2: row, column) whose centre deviates from the interpolation of their corners, with bounds
        of their distance.
        """
        points, away = view.points_m, view.distance_m
        four = [(slice(a, len(away) - 1 + a), slice(b, away.shape[1] - 1 + b)) for a in (0, 1) for b in (0, 1)]
        corners, corners_m = (np.stack([v[at] for at in four])[:, ground] for v in (points, away))
        cells = np.argwhere(ground)
        centre_point = self._ground_of_pixels(view, (cells[:, ::-1] + 0.5) * GRID_PX, 0.0, VIEW_M)
        centre_m = np.linalg.norm(centre_point - view.p_c_in_w_m, axis=1)
        near_m, far_m = np.minimum(corners_m.min(axis=0), centre_m), np.maximum(corners_m.max(axis=0), centre_m)
        between = (corners / corners_m[..., None]).sum(axis=0) / (1.0 / corners_m).sum(axis=0)[:, None]
        off_px = np.hypot(*(between - centre_point)[:, :2].T) / (near_m * self._pixel_rad)
        curved = (off_px > CURVATURE_PX) & (far_m < CURVATURE_MAX_DISTANCE_M)
        return cells[curved], near_m[curved] / DISTANCE_MARGIN, far_m[curved] * DISTANCE_MARGIN

    def _ground_of_pixels(
        self, view: View, px: np.ndarray, after_m: np.ndarray | float, before_m: np.ndarray | float
    ) -> np.ndarray:
        """Intersects the rays of pixels (N, 2) with the ground between two distances; (N, 3), the end of the ray if
        there is none.
        """
        from_m, rotations = view.motion.pose(view.p_c_in_w_m, view.r_w_c, self._row_times_s(px[:, 1]))
        rays = np.einsum("nij,nj->ni", rotations, self._lens.rays(px))
        distance_m = self._ground.relief.intersect(from_m, rays, after_m, before_m)
        return from_m + rays * np.minimum(distance_m, before_m)[:, None]

    # --- light, air, motion ---

    def _with_weather(self, image: np.ndarray, view: View, t_s: float) -> np.ndarray:
        light = self._sky.light(view.points_m, t_s)
        if light is not None:
            factor = self._grid.dense(light)
            image = cv2.multiply(image, cv2.merge([factor] * 3), dtype=cv2.CV_8U)
        haze = self._sky.haze(view.distance_m)
        if haze is not None:
            image = blend(image, self._grid.dense(haze), AIR_BGR)
        cloud = self._sky.cover(view.from_m, view.rays, t_s)
        return image if cloud is None else blend(image, self._grid.dense(cloud), CLOUD_BGR)

    def _flow_px_per_s(self, view: View) -> np.ndarray:
        """Optical flow of the ground: (H, W, 2) float32, px/s."""
        times_s = self._row_times_s(self._grid.row_px) + FLOW_S
        from_m, rotations = view.motion.pose(view.p_c_in_w_m, view.r_w_c, times_s)
        in_c = np.einsum("rji,rcj->rci", rotations, view.points_m - from_m[:, None, :])
        flow = ((self._lens.project(in_c.reshape(-1, 3)) - self._grid.px) / FLOW_S).reshape(*self._grid.shape, 2)
        return cv2.merge([self._grid.dense(flow[..., i]) for i in (0, 1)])
