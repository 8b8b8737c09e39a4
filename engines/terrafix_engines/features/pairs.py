"""What an image pair matcher returns: corresponding points."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class PixelPairs:
    """``first_px``, ``second_px`` (N, 2) float32, 0 is the centre of the first pixel; ``confidence`` (N,), 0 to 1."""

    first_px: np.ndarray
    second_px: np.ndarray
    confidence: np.ndarray
