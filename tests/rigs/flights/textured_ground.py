"""Textured ground, flat at height zero or sloped, views of it by a camera, and the ground as a map."""

from functools import lru_cache

import cv2
import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import rot_w_b

GSD_M = 0.25
SIDE_M = 500.0
DOWN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # R_b_c: straight down, image top forward
PINHOLE = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
LENS = CameraCalibration(640, 360, 380.0, 385.0, 310.0, 185.0, (-0.12, 0.03, 0.001, -0.0008))


def texture(seed: int = 0, side_m: float = SIDE_M) -> np.ndarray:
    """-> (H, W, 3) uint8, GSD_M per pixel, north up, centre at (0, 0): structures of many sizes without repetition."""
    return _texture(seed, side_m).copy()


@lru_cache(maxsize=6)
def _texture(seed: int, side_m: float) -> np.ndarray:
    rng = np.random.default_rng(seed)
    side = round(side_m / GSD_M)
    image = np.full((side, side), 110.0, np.float32)
    for cells, contrast in ((8, 25.0), (30, 18.0), (120, 14.0), (400, 9.0)):
        image += cv2.resize(rng.normal(0.0, contrast, (cells, cells)).astype(np.float32), (side, side))
    for _ in range(round(1800 * (side_m / SIDE_M) ** 2)):
        centre, size = rng.uniform(0, side, 2), rng.uniform(8, 60, 2)
        box = cv2.boxPoints((centre.tolist(), size.tolist(), float(rng.uniform(0, 180))))
        cv2.fillPoly(image, [box.astype(np.int32)], float(rng.uniform(30, 220)))
    image = cv2.GaussianBlur(image, (0, 0), 1.2)
    return cv2.merge([np.clip(image * k, 0, 255).astype(np.uint8) for k in (0.9, 1.0, 1.05)])


def rotation(yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> np.ndarray:
    """-> R_w_c of a camera that looks straight down in a body with these angles."""
    return rot_w_b(*np.radians([yaw_deg, pitch_deg, roll_deg])) @ DOWN


def view(
    ground: np.ndarray,
    camera: CameraCalibration,
    r_w_c: np.ndarray,
    p_c_in_w_m: np.ndarray,
    slope: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:
    """-> (H, W, 3) uint8 image of the camera; exact except for interpolation. ``slope``: rise of the ground per metre,
    east and north, from height zero at (0, 0)."""
    x, y = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = np.column_stack([camera.normalise(np.column_stack([x.ravel(), y.ravel()])), np.ones(x.size)]) @ r_w_c.T
    assert rays[:, 2].max() < 0, "the camera sees the sky"
    rise = np.array(slope)
    along = rays[:, :2] / (rays[:, 2:] - (rays[:, :2] @ rise)[:, None])  # per metre above the ground below the camera
    points = p_c_in_w_m[:2] - along * (p_c_in_w_m[2] - rise @ p_c_in_w_m[:2])
    centre = len(ground) / 2
    column = (points[:, 0] / GSD_M + centre - 0.5).astype(np.float32).reshape(x.shape)
    row = (centre - points[:, 1] / GSD_M - 0.5).astype(np.float32).reshape(x.shape)
    finer = p_c_in_w_m[2] / camera.fx < 2 * GSD_M
    return cv2.remap(ground, column, row, cv2.INTER_CUBIC if finer else cv2.INTER_AREA)


class FlatMap:
    """The ground with the interface of ``LocalMap`` that the matcher uses: windows in local metres, invalid beyond the
    edges. ``shift_m``: error of the map, east and north."""

    gsd_m = GSD_M

    def __init__(self, ground: np.ndarray, shift_m: tuple[float, float] = (0.0, 0.0)) -> None:
        self._ground, self._shift_m = ground, shift_m

    def window(
        self, e_min_m: float, n_max_m: float, width_px: int, height_px: int, gsd_m: float
    ) -> tuple[np.ndarray, np.ndarray]:
        centre = len(self._ground) / 2
        k = gsd_m / GSD_M
        x0 = (e_min_m - self._shift_m[0]) / GSD_M + centre + 0.5 * k - 0.5
        y0 = centre - (n_max_m - self._shift_m[1]) / GSD_M + 0.5 * k - 0.5
        source = cv2.GaussianBlur(self._ground, (0, 0), 0.5 * np.sqrt(k * k - 1)) if k > 1.2 else self._ground
        matrix = np.array([[k, 0.0, x0], [0.0, k, y0]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        image = cv2.warpAffine(source, matrix, (width_px, height_px), flags=flags)
        white = np.full(self._ground.shape[:2], 255, np.uint8)
        return image, cv2.warpAffine(white, matrix, (width_px, height_px), flags=flags) == 255

    def elevation(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray | None:
        return None


class SlopedMap(FlatMap):
    """The ground with a DEM: a plane with ``slope`` (rise per metre, east and north), at ``amsl_m`` in (0, 0)."""

    def __init__(self, ground: np.ndarray, slope: tuple[float, float], amsl_m: float) -> None:
        super().__init__(ground)
        self._slope, self._amsl_m = slope, amsl_m

    def elevation(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray | None:
        return np.asarray(self._amsl_m + self._slope[0] * e_m + self._slope[1] * n_m)
