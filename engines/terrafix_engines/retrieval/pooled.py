"""Pooled oriented gradients: eight numbers per cell, for cells of about a tenth of the height above ground.

The dense descriptor of `features/gradient.py`, computed on fine pixels and averaged over square cells: a histogram of
oriented gradients (Dalal and Triggs, CVPR 2005) with non-overlapping cells. A cell contains the strength of each
orientation but not its position in the cell, which makes it robust to heading errors of degrees, changed shadows and
map errors of metres. Gradients of a downscaled image are not robust to these."""

import cv2
import numpy as np

from terrafix_engines.features.gradient import CHANNELS, GradientDescriber

POOL = 4  # side of a cell, pixels


class PooledGradientDescriber:
    name = "pooled-gradient-1"  # stored in map packages: increment it when the descriptors of the same ground change
    channels = CHANNELS
    stride = POOL
    grayscale = True  # takes grey images

    def __init__(self) -> None:
        self._dense = GradientDescriber()

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR, or (H, W) grey -> (CHANNELS, H // POOL, W // POOL) float32"""
        dense = self._dense.describe(image)
        height, width = image.shape[0] // POOL, image.shape[1] // POOL
        cells = np.empty((CHANNELS, height, width), np.float32)
        for channel, into in zip(dense, cells, strict=True):
            cv2.resize(channel[: height * POOL, : width * POOL], (width, height), into, interpolation=cv2.INTER_AREA)
        return cells
