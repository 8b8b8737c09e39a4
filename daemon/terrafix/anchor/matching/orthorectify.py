"""Orthorectification of the frame: north-up at a chosen ground sampling distance, from attitude and height above ground
(PB-6)."""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.anchor.matching.interpolation import interpolated
from terrafix.core.camera import CameraCalibration
from terrafix.core.node import Image

# heights: ground farther than this from the nadir (58 degrees) is seen too obliquely to be matched [tuned]
MAX_GROUND_DISTANCE = 1.6
# smallest cosine between optical axis and vertical: that limit with a margin for the image corners [tuned]
MIN_AXIS_DOWN = 0.3
# Pixels of the image in one of the rectified image from which on it is smoothed. [tuned]
SMOOTHED_SHRINK = 1.4
# Pixels of the rectified image between two that a lens with distortion is evaluated for; between them it is
# interpolated, to a twentieth of a rectified pixel for a k1 of -0.2. [measured: test_orthorectify]
LENS_STEP_PX = 4
OUTSIDE_PX = -1e6  # of ground behind the camera, so that no interpolated pixel is inside [spec: any far pixel]

# Metres (N,) by which the ground rises above the plane of projection, at points (N, 2), east and north [m] of the one
# below the camera.
Relief = Callable[[np.ndarray], np.ndarray]


class Pyramid:
    """An image, in colour or grey, and its halves, each computed when it is first needed."""

    def __init__(self, image: Image) -> None:
        self._levels = [image]

    def level(self, halvings: int) -> Image:
        """The image, halved so many times; of an odd side without its last pixel."""
        while len(self._levels) <= halvings:
            finer = self._levels[-1]
            height, width = (side // 2 for side in finer.shape[:2])
            even = finer[: 2 * height, : 2 * width]
            self._levels.append(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA))
        return self._levels[halvings]


@dataclass(frozen=True)
class Rectified:
    """``image`` (H, W, 3), or (H, W) if grey, and ``mask`` (H, W) bool, north-up. The centre of pixel (r, c) lies at
    east = e_min_m + (c + 0.5) gsd, north = n_max_m - (r + 0.5) gsd, relative to the point below the camera."""

    image: np.ndarray
    mask: np.ndarray
    e_min_m: float
    n_max_m: float
    gsd_m: float


def footprint(camera: CameraCalibration, r_w_c: np.ndarray, agl_m: float) -> tuple[float, float, float, float] | None:
    """Bounding box of the visible ground (e_min, n_min, e_max, n_max) in metres from the nadir point; None: no ground
    is visible. ``r_w_c``: camera to world (east, north, up)."""
    w, h = camera.width - 1.0, camera.height - 1.0
    rim = [(x * w, y * h) for x, y in ((0, 0), (0.5, 0), (1, 0), (1, 0.5), (1, 1), (0.5, 1), (0, 1), (0, 0.5))]
    rays = np.column_stack([camera.normalise(np.array(rim)), np.ones(len(rim))]) @ r_w_c.T
    if float(r_w_c[2, 2]) > -MIN_AXIS_DOWN:  # the optical axis is too close to the horizon
        return None
    ground = rays[:, :2] / np.maximum(-rays[:, 2:], 1e-3) * agl_m
    ground = np.clip(ground, -MAX_GROUND_DISTANCE * agl_m, MAX_GROUND_DISTANCE * agl_m)
    low, high = ground.min(0), ground.max(0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def rectify(
    image: Image | Pyramid,
    camera: CameraCalibration,
    r_w_c: np.ndarray,
    agl_m: float,
    gsd_m: float,
    stride: int = 1,
    relief: Relief | None = None,
) -> Rectified | None:
    """Projects ``image``, in colour or grey, on the ground: ``relief`` over a plane ``agl_m`` below the camera, or that
    plane. Sides are multiples of ``stride`` pixels. None: no ground is visible."""
    box = footprint(camera, r_w_c, agl_m)
    if box is None:
        return None
    e_min, n_min, e_max, n_max = box
    cell = gsd_m * stride
    width = int(np.ceil((e_max - e_min) / cell)) * stride
    height = int(np.ceil((n_max - n_min) / cell)) * stride
    ground = np.array([[gsd_m, 0.0, e_min + 0.5 * gsd_m], [0.0, -gsd_m, n_max - 0.5 * gsd_m], [0.0, 0.0, -agl_m]])
    shrink = gsd_m / (agl_m / camera.fx)
    pyramid = image if isinstance(image, Pyramid) else Pyramid(image)
    # Against aliasing, of a half of the image where it is as fine as needed, which takes a tenth of the time.
    halvings = int(np.log2(np.clip(shrink / SMOOTHED_SHRINK, 1.0, min(pyramid.level(0).shape[:2]))))
    source, share = pyramid.level(halvings), 0.5**halvings
    if shrink > SMOOTHED_SHRINK:
        source = cv2.GaussianBlur(source, (0, 0), 0.35 * share * shrink)
    rows, columns = source.shape[:2]
    if camera.distortion or camera.radial_k1 or camera.readout is not None or relief is not None:
        px = _lens_map(camera, r_w_c, ground, (height, width), share, relief)
        x, y = px[..., 0], px[..., 1]
        flat = cv2.remap(source, x, y, cv2.INTER_LINEAR)
        mask = (x >= 0) & (y >= 0) & (x <= columns - 1) & (y <= rows - 1)
    else:
        offset = 0.5 * share - 0.5  # pixel 0 spans -0.5 to 0.5
        halved = np.array([[share, 0.0, offset], [0.0, share, offset], [0.0, 0.0, 1.0]])
        matrix = halved @ camera.matrix() @ (r_w_c.T @ ground)
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        flat = cv2.warpPerspective(source, matrix, (width, height), flags=how)
        white = np.full((rows, columns), 255, np.uint8)
        mask = cv2.warpPerspective(white, matrix, (width, height), flags=how) > 250
    return Rectified(flat, mask, e_min, n_max, gsd_m)


def patch_centres(
    camera: CameraCalibration, r_w_c: np.ndarray, agl_m: float, frame: Rectified, cell_m: float, step: float
) -> np.ndarray:
    """(N, 2) row and column, in cells of ``cell_m``, of the points of a fixed grid of the image in its rectified
    ``frame``; ``step``: between two of them, normalised. Points of the image, because a grid of the frame begins at its
    border, which moves with height and attitude: other patches would be matched for a tenth of a degree."""
    w, h = camera.width - 1.0, camera.height - 1.0
    corners = camera.normalise(np.array([(0.0, 0.0), (w, 0.0), (w, h), (0.0, h)]))
    (left, top), (right, bottom) = np.ceil(corners.min(axis=0) / step), np.floor(corners.max(axis=0) / step) + 1.0
    y, x = (axis.ravel() * step for axis in np.mgrid[top:bottom, left:right])
    rays = np.column_stack([x, y, np.ones(len(x))]) @ r_w_c.T
    rays = rays[rays[:, 2] < -MIN_AXIS_DOWN]
    ground_m = rays[:, :2] / -rays[:, 2:] * agl_m
    return np.column_stack([frame.n_max_m - ground_m[:, 1], ground_m[:, 0] - frame.e_min_m]) / cell_m


def rays_to(ground_m: np.ndarray, agl_m: float, r_w_c: np.ndarray, relief: Relief | None) -> np.ndarray:
    """(N, 3) in the camera's axes: rays to the points ``ground_m`` (N, 2) of a rectified frame, east and north of the
    one below the camera; ``relief`` as in ``rectify``."""
    up_m = np.full(len(ground_m), -agl_m)
    return np.asarray(np.column_stack([ground_m, up_m if relief is None else up_m + relief(ground_m)]) @ r_w_c)


def _lens_map(
    camera: CameraCalibration,
    r_w_c: np.ndarray,
    ground: np.ndarray,
    sides: tuple[int, int],
    share: float,
    relief: Relief | None,
) -> np.ndarray:
    """(height, width, 2) float32: pixel of the frame, reduced to ``share`` of its sides, at each rectified pixel, far
    outside of it for ground behind the camera. ``ground`` (3, 3): rectified pixel (x, y, 1) -> point of the plane;
    ``sides``: height and width."""
    rows, columns = (side // LENS_STEP_PX + 2 for side in sides)
    x, y = np.meshgrid(np.arange(columns) * float(LENS_STEP_PX), np.arange(rows) * float(LENS_STEP_PX))
    pixels = np.column_stack([x.ravel(), y.ravel(), np.ones(x.size)])
    rays = pixels @ (r_w_c.T @ ground).T
    if relief is not None:
        rays += relief(pixels @ ground[:2].T)[:, None] * r_w_c[2]
    behind = rays[:, 2] <= 0
    rays[behind] = (0.0, 0.0, 1.0)
    px = share * (camera.project(rays) + 0.5) - 0.5
    px[behind] = OUTSIDE_PX
    coarse = px.reshape(rows, columns, 2).astype(np.float32)
    return interpolated(coarse, LENS_STEP_PX, *sides)
