"""The lens as the smoother estimates it: focal length and radial coefficient, one of each for a flight."""

from dataclasses import dataclass

import numpy as np

from terrafix.core.camera import distort_division, undistort_division


@dataclass(frozen=True)
class Lens:
    """``log_focal``: logarithm of the true focal length over the described one. ``k1``: radial coefficient of the
    division model beyond the description, in image coordinates normalised by the true focal length."""

    k1: float = 0.0
    log_focal: float = 0.0

    def rays(self, described: np.ndarray) -> np.ndarray:
        """Image coordinates (N, 2) normalised by the description -> rays (N, 2), tangents."""
        return undistort_division(self.normalised(described), self.k1)

    def normalised(self, described: np.ndarray) -> np.ndarray:
        """... normalised by the true focal length, still distorted; any shape."""
        return np.asarray(described * np.exp(-self.log_focal))


def as_described(xy: np.ndarray, k1: float) -> np.ndarray:
    """Inverse of ``Lens(k1).rays``: what the description alone gives for points (N, 2) that were undistorted by ``k1``
    in flight."""
    return distort_division(xy, k1) if k1 else xy
