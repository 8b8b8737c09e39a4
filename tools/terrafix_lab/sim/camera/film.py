"""Sensor model: converts an ideal image to a camera's output. Every error is a function of (seed, index)."""

import math
from dataclasses import dataclass

import cv2
import numpy as np

STEP_FRAMES = 12  # number of images for which automatic exposure keeps its gain
NOISE_ROOM_PX = 256  # the noise array is larger than an image by this; every image gets another part of it
LONGEST_BLUR_PX = 40.0  # longer blur leaves no usable image


@dataclass(frozen=True)
class Film:
    """Image errors of a camera."""

    noise: float = 2.0  # grey values, 1-sigma
    vignette: float = 0.2  # brightness loss in the corners
    blur_px: float = 0.6
    exposure_jitter: float = 0.04  # 1-sigma of the gain from frame to frame
    exposure_step: float = 0.0  # 1-sigma of the gain of automatic exposure, which changes in steps
    detail: float = 0.05  # contrast of the fine texture on the ground
    exposure_s: float = 0.0  # exposure time: motion blur
    # readout time from the first row to the last: rolling shutter; the pose is that of the middle row
    readout_s: float = 0.0
    jpeg_quality: int | None = None  # 1..100; None: no compression


class Developer:
    """Applies a ``Film`` to images of one size."""

    def __init__(self, film: Film, width: int, height: int, centre_px: tuple[float, float], seed: int) -> None:
        self._film, self._seed = film, seed
        rng = np.random.default_rng([seed, 7])
        x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
        radius2 = ((x - centre_px[0]) ** 2 + (y - centre_px[1]) ** 2) / (centre_px[0] ** 2 + centre_px[1] ** 2)
        shade = (255.0 * (1.0 - film.vignette * radius2)).clip(0, 255).astype(np.uint8)
        self._vignette = cv2.merge([shade, shade, shade])
        noise_shape = (height + NOISE_ROOM_PX, width + NOISE_ROOM_PX, 3)
        self._noise = np.clip(rng.normal(0.0, film.noise, noise_shape).round(), -127, 127).astype(np.int8)

    def develop(self, image: np.ndarray, index: int, flow_px_per_s: np.ndarray | None = None) -> np.ndarray:
        """Returns image number ``index`` (H, W, 3) uint8. ``flow_px_per_s`` (H, W, 2) float32: motion of the ground in
        the image.
        """
        film = self._film
        height, width = image.shape[:2]
        if film.exposure_s and flow_px_per_s is not None:
            image = _motion_blurred(image, flow_px_per_s * np.float32(film.exposure_s))
        if film.blur_px:
            image = cv2.GaussianBlur(image, (0, 0), film.blur_px)
        rng = np.random.default_rng([self._seed, 11, index])
        gain = 1.0 + film.exposure_jitter * float(rng.normal())
        if film.exposure_step:
            steps = np.random.default_rng([self._seed, 13, index // STEP_FRAMES])
            gain *= math.exp(film.exposure_step * float(steps.normal()))
        image = cv2.multiply(image, self._vignette, scale=gain / 255)
        if film.noise:
            top, left = (int(v) for v in rng.integers(NOISE_ROOM_PX, size=2))
            image = cv2.add(image, self._noise[top : top + height, left : left + width], dtype=cv2.CV_8U)
        if film.jpeg_quality is not None:
            packed = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, film.jpeg_quality])[1]
            image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR))
        return image


def _motion_blurred(image: np.ndarray, path_px: np.ndarray) -> np.ndarray:
    """Motion blur: the mean of the image along each pixel's path (H, W, 2), centred on the pixel."""
    longest = float(np.abs(path_px).max())
    if longest < 0.3:  # less than the blur of the optics
        return image
    path_px = path_px * np.float32(min(1.0, LONGEST_BLUR_PX / longest))
    samples = math.ceil(min(longest, LONGEST_BLUR_PX)) + 1
    x, y = np.meshgrid(np.arange(image.shape[1], dtype=np.float32), np.arange(image.shape[0], dtype=np.float32))
    total = np.zeros(image.shape, np.float32)
    for share in (np.arange(samples) + 0.5) / samples - 0.5:
        moved = x + np.float32(share) * path_px[..., 0], y + np.float32(share) * path_px[..., 1]
        cv2.accumulate(cv2.remap(image, *moved, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), total)
    return cv2.convertScaleAbs(total, alpha=1.0 / samples)
