"""Pooled oriented gradients: what a piece of ground a tenth of the height wide looks like, in eight numbers.

The dense descriptor of `features/gradient.py`, computed on fine pixels, averaged over square cells: a histogram of
oriented gradients (Dalal and Triggs, CVPR 2005) with cells that do not overlap. A cell keeps how much there is of each
direction and forgets where in the cell: that survives a heading that is off by degrees, other shadows and a map that is
off by metres. Gradients of the same ground made coarse first keep neither."""

import cv2
import numpy as np

from terrafix_engines.features.gradient import CHANNELS, GradientDescriber

POOL = 4  # pixels of a cell's side


class PooledGradientDescriber:
    name = "pooled-gradient-1"  # kept in map packages: another number when the same ground gives other descriptors
    channels = CHANNELS
    stride = POOL

    def __init__(self) -> None:
        self._dense = GradientDescriber()

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR -> (CHANNELS, H // POOL, W // POOL) float32"""
        dense = self._dense.describe(image)
        height, width = image.shape[0] // POOL, image.shape[1] // POOL
        cells = np.empty((CHANNELS, height, width), np.float32)
        for channel, into in zip(dense, cells, strict=True):
            cv2.resize(channel[: height * POOL, : width * POOL], (width, height), into, interpolation=cv2.INTER_AREA)
        return cells
