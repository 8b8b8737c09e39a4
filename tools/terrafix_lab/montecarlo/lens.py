"""A camera with errors of its calibration: focal length and radial distortion."""

import math
from dataclasses import dataclass, replace

import numpy as np

from terrafix.core.camera import CameraCalibration
from terrafix.messages import Camera


@dataclass(frozen=True)
class TrueLens:
    """The true camera. ``described``: its stated calibration. ``focal``: relative error of the focal length; ``k1``:
    error of the first radial coefficient."""

    described: CameraCalibration
    focal: float = 0.0
    k1: float = 0.0
    scale: tuple[float, float] = (1.0, 1.0)  # of the picture's content about the principal point

    def project(self, in_c: np.ndarray) -> np.ndarray:
        """Points in the camera's axes (N, 3), z > 0 -> pixels (N, 2) of the true camera."""
        xy = in_c[:, :2] / in_c[:, 2:]
        distorted = xy * (1.0 + self.focal) * (1.0 + self.k1 * (xy**2).sum(axis=1, keepdims=True))
        return np.column_stack([distorted * self.scale, np.ones(len(distorted))]) @ self.described.matrix()[:2].T

    def rays(self, px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) -> true rays (N, 3) in camera axes, depth 1."""
        distorted = self.described.normalise(px) / self.scale / (1.0 + self.focal)
        xy = distorted
        for _ in range(3):  # the distortion is small: each iteration reduces the error by a factor of 100
            xy = distorted / (1.0 + self.k1 * (xy**2).sum(axis=1, keepdims=True))
        return np.column_stack([xy, np.ones(len(xy))])

    def showing(self, scale: tuple[float, float]) -> "TrueLens":
        return replace(self, scale=scale)

    def scaled(self, factor: float) -> "TrueLens":
        return TrueLens(self.described.scaled(factor), self.focal, self.k1)


def footprint_m(camera: Camera | CameraCalibration, agl_m: float) -> float:
    """Side of a square of the area that a level picture shows from ``agl_m`` above the ground."""
    return agl_m * math.sqrt(camera.width / camera.fx * camera.height / camera.fy)
