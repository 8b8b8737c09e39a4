"""Lens models: rays of pixels, and pixels of rays."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrafix import messages as m
from terrafix.core.camera import CameraCalibration
from terrafix.vision.sources.fisheye import FisheyeCamera

NEWTON_STEPS = 12  # Newton steps; the angle of a real lens converges in five


class Lens(Protocol):
    """Camera frame c: x right, y down, z along the optical axis; pixel centres at whole numbers."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    def rays(self, px: np.ndarray) -> np.ndarray:
        """Converts pixels (N, 2) to unit rays in c (N, 3)."""

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        """Projects points in c (N, 3), in front of the camera, to pixels (N, 2)."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera with OpenCV's distortion."""

    calibration: CameraCalibration

    @property
    def width(self) -> int:
        return self.calibration.width

    @property
    def height(self) -> int:
        return self.calibration.height

    def rays(self, px: np.ndarray) -> np.ndarray:
        rays = np.column_stack([self.calibration.normalise(px), np.ones(len(px))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        return self.calibration.project(p_in_c)


@dataclass(frozen=True)
class Fisheye:
    """Kannala and Brandt 2006, as cv2.fisheye: r = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8), t the angle off axis."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def rays(self, px: np.ndarray) -> np.ndarray:
        x, y = (px[:, 0] - self.cx) / self.fx, (px[:, 1] - self.cy) / self.fy
        radius = np.hypot(x, y)
        angle = np.minimum(radius, math.pi)
        for _ in range(NEWTON_STEPS):
            angle = np.clip(angle - (self._radius(angle) - radius) / self._radius_derivative(angle), 0.0, math.pi)
        out = np.sin(angle) / np.maximum(radius, 1e-12)
        return np.column_stack([x * out, y * out, np.cos(angle)])

    def project(self, p_in_c: np.ndarray) -> np.ndarray:
        lateral = np.hypot(p_in_c[:, 0], p_in_c[:, 1])
        scale = self._radius(np.arctan2(lateral, p_in_c[:, 2])) / np.maximum(lateral, 1e-12)
        return p_in_c[:, :2] * scale[:, None] * (self.fx, self.fy) + (self.cx, self.cy)

    def _radius(self, angle: np.ndarray) -> np.ndarray:
        k1, k2, k3, k4 = self.distortion
        t2 = angle * angle
        return angle * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _radius_derivative(self, angle: np.ndarray) -> np.ndarray:
        k1, k2, k3, k4 = self.distortion
        t2 = angle * angle
        return np.maximum(1.0 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4))), 1e-3)


def lens_of(camera: m.Camera) -> Lens:
    """Returns the lens model of a camera description."""
    if isinstance(camera, FisheyeCamera):
        k1, k2, k3, k4 = camera.distortion
        return Fisheye(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy, (k1, k2, k3, k4))
    return Pinhole(CameraCalibration.of(camera))
