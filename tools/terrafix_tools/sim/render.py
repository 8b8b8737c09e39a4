"""What a camera sees over georeferenced ground: an image draped over a DEM, seen through a pinhole with distortion.

Rays of a coarse pixel grid are intersected with the DEM and the full frame is interpolated between them. That is
exact to a small part of a pixel over terrain as smooth as the DEM's posts make it (tested against a projection of
3D points)."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from pyproj import CRS, Transformer
from rasterio.transform import Affine

from terrafix import messages as m
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, local_crs
from terrafix_tools.sim.noise import periodic_noise

GRID_PX = 12  # spacing of the rays; the ground between them is nearly flat
ITERATIONS = 8  # of ray against DEM; slope x tangent of the view angle is far below one
LOWEST_RAY = 0.08  # rays closer to the horizon than this (sine) are bent down to it
DETAIL_PX = 1024  # size of the fine texture's tile
DETAIL_M = 0.15  # metres a pixel of it: finer than the drawn world, so that close views are not smooth
NOISE_BANK = 4  # noise images drawn once and reused at random offsets


@dataclass(frozen=True)
class Ground:
    """Georeferenced image and DEM in the local frame of a flight; affines take (e_m, n_m) to pixel centres."""

    image_bgr: np.ndarray  # (H, W, 3) uint8
    dem_amsl_m: np.ndarray  # (h, w) float32
    px_from_local: np.ndarray  # (2, 3)
    dem_from_local: np.ndarray  # (2, 3)

    def height_amsl_m(self, e_m: np.ndarray, n_m: np.ndarray) -> np.ndarray:
        """Ground height at local points (any 2-D shape), bilinear; beyond the DEM its edge goes on."""
        x, y = _apply(self.dem_from_local, np.asarray(e_m), np.asarray(n_m))
        return cv2.remap(self.dem_amsl_m, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class Film:
    """How a picture departs from the ideal one."""

    noise: float = 2.0  # grey values, 1-sigma
    vignette: float = 0.2  # brightness lost in the corners
    blur_px: float = 0.6
    exposure_jitter: float = 0.04  # 1-sigma of the gain from frame to frame
    detail: float = 0.05  # contrast of the fine texture on the ground


def drape(
    image_bgr: np.ndarray,
    crs_from_px: Affine,
    dem_amsl_m: np.ndarray,
    crs_from_dem: Affine,
    crs: CRS,
    frame: LocalFrame,
) -> Ground:
    """Rasters in a projected CRS -> the local frame.

    Both are transverse Mercator here, and the relation between them is affine to a centimetre over a few km."""
    height, width = image_bgr.shape[:2]
    back = Transformer.from_crs(crs, local_crs(frame.lat_deg, frame.lon_deg), always_xy=True)
    corners = np.array([(x, y) for x in (0.0, width / 2, width) for y in (0.0, height / 2, height)])
    east, north = _affine_points(crs_from_px, corners)
    local = np.column_stack(back.transform(east, north))
    design = np.column_stack([local, np.ones(len(local))])
    crs_from_local = np.linalg.lstsq(design, np.column_stack([east, north]), rcond=None)[0].T
    return Ground(
        image_bgr,
        np.ascontiguousarray(dem_amsl_m, dtype=np.float32),
        _px_from(crs_from_px, crs_from_local),
        _px_from(crs_from_dem, crs_from_local),
    )


class Renderer:
    """Frames of one camera over one ground. ``frame`` is a function of its arguments and of the seed."""

    def __init__(self, ground: Ground, camera: m.Camera, *, film: Film = Film(), seed: int = 0) -> None:
        self._ground, self._camera, self._film, self._seed = ground, camera, film, seed
        calibration = CameraCalibration(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion
        )
        self._cols, self._rows = (
            math.ceil((camera.width - 1) / GRID_PX) + 1,
            math.ceil((camera.height - 1) / GRID_PX) + 1,
        )
        px = np.stack(np.meshgrid(np.arange(self._cols), np.arange(self._rows)), axis=-1).reshape(-1, 2) * float(
            GRID_PX
        )
        self._rays_in_c = np.column_stack([calibration.normalise(px), np.ones(len(px))])
        x, y = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
        self._grid_x, self._grid_y = x / GRID_PX, y / GRID_PX
        rng = np.random.default_rng([seed, 7])
        radius2 = ((x - camera.cx) ** 2 + (y - camera.cy) ** 2) / (camera.cx**2 + camera.cy**2)
        self._vignette = (
            np.repeat((255.0 * (1.0 - film.vignette * radius2))[..., None], 3, axis=2).clip(0, 255).astype(np.uint8)
        )
        shape = (camera.height, camera.width, 3)
        self._noise = [rng.normal(0.0, film.noise, shape).round().astype(np.int16) for _ in range(NOISE_BANK)]
        fine = (
            periodic_noise(rng, DETAIL_PX, 0.8)
            + periodic_noise(rng, DETAIL_PX, 1.6)
            - 0.5 * periodic_noise(rng, DETAIL_PX, 4)
        )
        self._detail = np.clip(128.0 * (1.0 + film.detail * fine), 0, 255).astype(np.uint8)

    def ground_points(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
        """Where the rays of the coarse grid meet the ground: (rows, cols, 3) east, north, up."""
        rays = self._rays_in_c @ r_w_c.T
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        rays[:, 2] = np.minimum(rays[:, 2], -LOWEST_RAY)
        rays = rays.reshape(self._rows, self._cols, 3)
        here = np.array([[p_c_in_w_m[0]]]), np.array([[p_c_in_w_m[1]]])
        up = np.full(rays.shape[:2], float(self._ground.height_amsl_m(*here)[0, 0]))
        for _ in range(ITERATIONS):
            points = p_c_in_w_m + rays * ((up - p_c_in_w_m[2]) / rays[..., 2])[..., None]
            up = self._ground.height_amsl_m(points[..., 0], points[..., 1])
        return np.concatenate([points[..., :2], up[..., None]], axis=2)

    def ideal(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray) -> np.ndarray:
        """The scene through the lens, before film and light: (H, W, 3) uint8."""
        points = self.ground_points(p_c_in_w_m, r_w_c)
        map_x, map_y = (self._dense(v) for v in _apply(self._ground.px_from_local, points[..., 0], points[..., 1]))
        image = cv2.remap(self._ground.image_bgr, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        if not self._film.detail:
            return image
        tile_x, tile_y = (self._dense((points[..., i] / DETAIL_M).astype(np.float32)) for i in (0, 1))
        fine = cv2.remap(self._detail, tile_x, tile_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        return cv2.multiply(image, cv2.merge([fine, fine, fine]), scale=1 / 128)

    def frame(self, p_c_in_w_m: np.ndarray, r_w_c: np.ndarray, index: int) -> np.ndarray:
        """Picture number ``index`` of the flight: (H, W, 3) uint8 BGR. p_c_in_w_m (3,), r_w_c (3, 3)."""
        rng = np.random.default_rng([self._seed, 11, index])
        image = self.ideal(p_c_in_w_m, r_w_c)
        if self._film.blur_px:
            image = cv2.GaussianBlur(image, (0, 0), self._film.blur_px)
        gain = 1.0 + self._film.exposure_jitter * float(rng.normal())
        image = cv2.multiply(image, self._vignette, scale=gain / 255)
        noise = self._noise[int(rng.integers(NOISE_BANK))]
        shifted = np.roll(noise, (int(rng.integers(noise.shape[0])), int(rng.integers(noise.shape[1]))), (0, 1))
        return cv2.add(image, shifted, dtype=cv2.CV_8U)

    def _dense(self, coarse: np.ndarray) -> np.ndarray:
        """Values at the coarse grid -> at every pixel (H, W) float32."""
        return cv2.remap(coarse, self._grid_x, self._grid_y, cv2.INTER_LINEAR)


def _apply(affine: np.ndarray, e_m: np.ndarray, n_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = affine[0, 0] * e_m + affine[0, 1] * n_m + affine[0, 2]
    y = affine[1, 0] * e_m + affine[1, 1] * n_m + affine[1, 2]
    return x.astype(np.float32), y.astype(np.float32)


def _affine_points(affine: Affine, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = affine.a * points[:, 0] + affine.b * points[:, 1] + affine.c
    y = affine.d * points[:, 0] + affine.e * points[:, 1] + affine.f
    return x, y


def _px_from(crs_from_px: Affine, crs_from_local: np.ndarray) -> np.ndarray:
    """(2, 3) local metres -> pixel centres (a corner is at -0.5)."""
    inverse = ~crs_from_px
    px_from_crs = np.array([[inverse.a, inverse.b, inverse.c - 0.5], [inverse.d, inverse.e, inverse.f - 0.5]])
    return px_from_crs @ np.vstack([crs_from_local, [0.0, 0.0, 1.0]])
