"""Reprojection error of point pairs of two pictures, with a free depth for each point."""

import cv2
import numpy as np

# Only the error across the epipolar line is observable. For isotropic errors, the mean length is this many times the
# mean across the line: ratio of the means of the Rayleigh and the half-normal distribution.
LENGTH_PER_ACROSS = np.pi / 2


def reprojection_error(pairs: np.ndarray) -> float:
    """``pairs`` (N, 4) normalised, N >= 8. -> mean length of the error of a point in a picture, normalised.

    The camera motion comes from the best homography; of its decompositions (Malis and Vargas, "Deeper understanding of
    the homography decomposition", 2007) the one with the smallest residual is taken. The residual of a point is
    Sampson's distance (Hartley and Zisserman, "Multiple View Geometry", 11.4.3), the length of its error in both
    pictures."""
    a, b = (np.column_stack([view, np.ones(len(view))]) for view in (pairs[:, :2], pairs[:, 2:]))
    homography, _ = cv2.findHomography(pairs[:, :2], pairs[:, 2:], 0)
    _, rotations, translations, _ = cv2.decomposeHomographyMat(homography, np.eye(3))
    across = [_sampson(_essential(r, t.ravel()), a, b) for r, t in zip(rotations, translations, strict=True)]
    return float(LENGTH_PER_ACROSS * min(across))


def _essential(r: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Essential matrix [t]x R of a rotation and a direction of translation."""
    length = np.linalg.norm(t)
    x, y, z = t / length if length > 0.0 else (0.0, 0.0, 1.0)  # without motion any direction is valid
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ r


def _sampson(essential: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Mean of Sampson's distance over homogeneous points (N, 3), (N, 3)."""
    in_b, in_a = a @ essential.T, b @ essential
    gradient = np.sqrt(np.sum(in_b[:, :2] ** 2, axis=1) + np.sum(in_a[:, :2] ** 2, axis=1))
    return float(np.mean(np.abs(np.sum(b * in_b, axis=1)) / np.maximum(gradient, 1e-12)))
