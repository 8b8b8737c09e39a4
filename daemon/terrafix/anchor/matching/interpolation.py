"""Values between the cells of a coarse grid."""

import cv2
import numpy as np


def interpolated(coarse: np.ndarray, step: int, height: int, width: int) -> np.ndarray:
    """``coarse`` (h, w) or (h, w, 2) float32, the values at every ``step``-th row and column -> those of all ``height``
    rows and ``width`` columns, bilinear. ``step``: 2 or 4, of which OpenCV's steps of 1/32 are multiples."""
    by_step = np.array([[1.0 / step, 0.0, 0.0], [0.0, 1.0 / step, 0.0]])
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(cv2.warpAffine(coarse, by_step, (width, height), flags=how, borderMode=cv2.BORDER_REPLICATE))
