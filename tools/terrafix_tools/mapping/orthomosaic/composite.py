"""Frames projected onto the ground, and of all frames that show a place the one that looks at it most steeply."""

from dataclasses import dataclass

import cv2
import numpy as np
from pyproj import CRS, Transformer

from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame, local_crs
from terrafix.estimator.state import HORIZONTAL, UP
from terrafix_tools.locate.cloud import Elevation
from terrafix_tools.locate.views import CameraView

STEP_PX = 16  # of the grid on which ground and lens are computed; between its points the mapping is interpolated
MARGIN_PX = 2  # at the border of a frame, where a lens model is least exact
MAX_TANGENT = 1.0  # of the angle off the vertical: 45 degrees, beyond which houses hide the ground
MAX_PIXELS = 400_000_000


@dataclass(frozen=True)
class OrthomosaicGrid:
    """North-up raster in ``crs``: pixel (row, column) covers [x_min + column px, y_max - row px)."""

    crs: CRS
    x_min: float
    y_max: float
    gsd_m: float
    width_px: int
    height_px: int


def grid_around(views: list[CameraView], frame: LocalFrame, crs: CRS, gsd_m: float | None) -> OrthomosaicGrid:
    """Raster of the ground that ``views`` see. ``gsd_m``: None: the median ground pixel of the frames.

    Raises UsageError: too many pixels."""
    corners = np.concatenate([_corners_m(view) for view in views])
    x, y = Transformer.from_crs(local_crs(frame.lat_deg, frame.lon_deg), crs, always_xy=True).transform(*corners.T)
    size_m = gsd_m or float(np.median([view.height_m / view.calibration.fx for view in views]))
    width_px, height_px = (int(np.ceil(np.ptp(axis) / size_m)) + 1 for axis in (x, y))
    if width_px * height_px > MAX_PIXELS:
        raise UsageError(
            f"{width_px} x {height_px} pixels of {size_m:.2f} m are too many; give a coarser --gsd, for example "
            f"{size_m * np.sqrt(width_px * height_px / MAX_PIXELS):.2f}"
        )
    return OrthomosaicGrid(crs, float(np.min(x)), float(np.max(y)), size_m, width_px, height_px)


def is_steep(ray: np.ndarray) -> bool:
    """Whether a ray (3,), world axes, is at most MAX_TANGENT off the vertical."""
    return bool(np.hypot(*ray[HORIZONTAL]) <= -MAX_TANGENT * ray[UP])


def _corners_m(view: CameraView) -> np.ndarray:
    """(4, 2) east, north: where the corners of the frame meet level ground, at most MAX_TANGENT off the vertical."""
    camera = view.calibration
    px = np.array([[0, 0], [camera.width, 0], [camera.width, camera.height], [0, camera.height]], float)
    rays = np.column_stack([camera.normalise(px), np.ones(4)]) @ view.r_w_c.T
    level = rays[:, HORIZONTAL] / np.maximum(-rays[:, UP:], 1e-3)
    level *= np.minimum(1.0, MAX_TANGENT / np.maximum(np.hypot(*level.T), 1e-9))[:, None]
    return np.asarray(view.p_c_in_w_m[HORIZONTAL] + view.height_m * level)


class Composite:
    """``image`` (H, W, 3) uint8 BGR; ``steepness`` (H, W) float32: squared tangent off the vertical of the frame that a
    pixel is of, inf: none; ``frame_of`` (H, W) int32: its frame id, -1: none."""

    def __init__(self, grid: OrthomosaicGrid, frame: LocalFrame, elevation: Elevation | None) -> None:
        shape = grid.height_px, grid.width_px
        self.grid = grid
        self.image = np.zeros((*shape, 3), np.uint8)
        self.steepness = np.full(shape, np.inf, np.float32)
        self.frame_of = np.full(shape, -1, np.int32)
        self._elevation = elevation
        local = local_crs(frame.lat_deg, frame.lon_deg)
        self._to_local = Transformer.from_crs(grid.crs, local, always_xy=True)
        self._from_local = Transformer.from_crs(local, grid.crs, always_xy=True)

    @property
    def valid(self) -> np.ndarray:
        return self.frame_of >= 0

    def add(self, view: CameraView, image: np.ndarray) -> None:
        """Draws a frame where it looks at the ground more steeply than those before."""
        window = self._window(view)
        if window is None:
            return
        rows, columns = window
        shape = rows.stop - rows.start, columns.stop - columns.start
        px, tangent2 = self._projected(view, rows, columns)
        u, v, tangent2 = (_enlarged(part, shape) for part in (px[..., 0], px[..., 1], tangent2))
        camera = view.calibration
        better = (u > MARGIN_PX) & (u < camera.width - 1 - MARGIN_PX) & (v > MARGIN_PX)
        better &= (v < camera.height - 1 - MARGIN_PX) & (tangent2 < np.minimum(self.steepness[window], MAX_TANGENT**2))
        drawn = cv2.remap(image, u, v, cv2.INTER_LINEAR)
        self.image[window][better] = drawn[better]
        self.steepness[window][better] = tangent2[better]
        self.frame_of[window][better] = view.frame_id

    def _window(self, view: CameraView) -> tuple[slice, slice] | None:
        """Rows and columns of the raster that the frame may show; None: none."""
        x, y = self._from_local.transform(*_corners_m(view).T)
        grid = self.grid
        columns = (np.array([np.min(x), np.max(x)]) - grid.x_min) / grid.gsd_m
        rows = (grid.y_max - np.array([np.max(y), np.min(y)])) / grid.gsd_m
        first_row, last_row = (int(np.clip(edge, 0, grid.height_px)) for edge in (rows[0], rows[1] + 1))
        first_column, last_column = (int(np.clip(edge, 0, grid.width_px)) for edge in (columns[0], columns[1] + 1))
        if first_row >= last_row or first_column >= last_column:
            return None
        return slice(first_row, last_row), slice(first_column, last_column)

    def _projected(self, view: CameraView, rows: slice, columns: slice) -> tuple[np.ndarray, np.ndarray]:
        """Pixels of the frame (R, C, 2) and squared tangents off the vertical (R, C) on a coarse grid over the window,
        whose ends are the centres of the first and the last pixel; inf behind the camera."""
        grid = self.grid
        row = np.linspace(rows.start, rows.stop - 1, max(2, -(-(rows.stop - rows.start) // STEP_PX) + 1))
        column = np.linspace(columns.start, columns.stop - 1, max(2, -(-(columns.stop - columns.start) // STEP_PX) + 1))
        x, y = np.meshgrid(grid.x_min + (column + 0.5) * grid.gsd_m, grid.y_max - (row + 0.5) * grid.gsd_m)
        e_m, n_m = self._to_local.transform(x.ravel(), y.ravel())
        points_m = np.column_stack([e_m, n_m, self._ground_m(view, e_m, n_m)])
        away_m = points_m - view.p_c_in_w_m
        in_c = away_m @ view.r_w_c
        px = np.full((len(in_c), 2), -1e6)
        ahead = (in_c[:, 2] > 0.0) & (away_m[:, UP] < 0.0)
        tangent2 = np.full(len(in_c), np.inf)
        tangent2[ahead] = np.sum(away_m[ahead, :UP] ** 2, axis=1) / away_m[ahead, UP] ** 2
        # Far outside the frame the polynomial of a lens folds back into it.
        ahead &= tangent2 < 4.0 * MAX_TANGENT**2
        px[ahead] = view.calibration.project(in_c[ahead])
        return px.reshape(*x.shape, 2), tangent2.reshape(x.shape)

    def _ground_m(self, view: CameraView, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        known_m = None if self._elevation is None else self._elevation(e_m, n_m)
        if known_m is None:
            return np.full(len(e_m), view.ground_m)
        return np.where(np.isnan(known_m), view.ground_m, known_m)


def _enlarged(coarse: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """A coarse grid whose ends are pixel centres -> every pixel (float32), bilinear."""
    rows, columns = (np.linspace(0, n - 1, m, dtype=np.float32) for n, m in zip(coarse.shape, shape, strict=True))
    finite = np.where(np.isfinite(coarse), coarse, 1e6).astype(np.float32)
    return cv2.remap(finite, np.tile(columns, (shape[0], 1)), np.tile(rows[:, None], (1, shape[1])), cv2.INTER_LINEAR)
