"""A camera that is not quite as its description says: focal length and distortion are never known exactly."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import CameraCalibration


@dataclass(frozen=True)
class Lens:
    """The real camera behind a described one. ``focal`` and ``k1``: error of the focal length, relative, and of the
    first radial coefficient."""

    described: CameraCalibration
    focal: float = 0.0
    k1: float = 0.0

    def project(self, in_c: np.ndarray) -> np.ndarray:
        """Points in the camera's axes (N, 3), z > 0 -> pixels (N, 2) of the picture as it really is."""
        xy = in_c[:, :2] / in_c[:, 2:]
        bent = xy * (1.0 + self.focal) * (1.0 + self.k1 * (xy**2).sum(axis=1, keepdims=True))
        return np.column_stack([bent, np.ones(len(bent))]) @ self.described.matrix()[:2].T

    def rays(self, px: np.ndarray) -> np.ndarray:
        """Pixels (N, 2) -> where they really look: (N, 3) in the camera's axes, depth 1."""
        seen = self.described.normalise(px) / (1.0 + self.focal)
        xy = seen
        for _ in range(3):  # the distortion is small: each turn is a hundred times nearer
            xy = seen / (1.0 + self.k1 * (xy**2).sum(axis=1, keepdims=True))
        return np.column_stack([xy, np.ones(len(xy))])

    def scaled(self, factor: float) -> "Lens":
        return Lens(self.described.scaled(factor), self.focal, self.k1)
