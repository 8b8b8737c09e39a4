"""Reprojection error of two pictures whose points have depths of their own."""

import cv2
import numpy as np

# Two pictures show of an error only what lies across the epipolar line. Where errors have no direction, their mean
# length is so many times the mean of that: the means of the Rayleigh and of the half-normal distribution.
WHOLE_OF_ACROSS = np.pi / 2


def reprojection_error(pairs: np.ndarray) -> float:
    """``pairs`` (N, 4) normalised, N >= 8. -> mean length of the error of a point in a picture, normalised.

    How the camera moved is that of the plane which fits best; of its solutions (Malis and Vargas, "Deeper understanding
    of the homography decomposition", 2007) the one that leaves least. What is left of a point then is Sampson's
    distance (Hartley and Zisserman, "Multiple View Geometry", 11.4.3), the length of its error in both pictures."""
    a, b = (np.column_stack([view, np.ones(len(view))]) for view in (pairs[:, :2], pairs[:, 2:]))
    homography, _ = cv2.findHomography(pairs[:, :2], pairs[:, 2:], 0)
    _, turns, ways, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    across = [_sampson(_essential(turn, way.ravel()), a, b) for turn, way in zip(turns, ways, strict=True)]
    return float(WHOLE_OF_ACROSS * min(across))


def _essential(turn: np.ndarray, way: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(way)
    x, y, z = way / length if length > 0.0 else (0.0, 0.0, 1.0)  # where nothing moved any line is as good
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ turn


def _sampson(essential: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Mean over homogeneous points (N, 3), (N, 3)."""
    in_b, in_a = a @ essential.T, b @ essential
    steep = np.sqrt(np.sum(in_b[:, :2] ** 2, axis=1) + np.sum(in_a[:, :2] ** 2, axis=1))
    return float(np.mean(np.abs(np.sum(b * in_b, axis=1)) / np.maximum(steep, 1e-12)))
