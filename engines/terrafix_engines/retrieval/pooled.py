"""Pooled dense descriptors: the mean of finely computed ones over larger, square cells.

Of oriented gradients it is a histogram with non-overlapping cells (Dalal and Triggs, CVPR 2005). A cell contains the
strength of each orientation but not its position in the cell, which makes it robust to heading errors of degrees,
changed shadows and map errors of metres. Descriptors of a downscaled image are not robust to these."""

from typing import Protocol

import cv2
import numpy as np

from terrafix_engines.features.gradient import CHANNELS, GradientDescriber

POOL = 4  # side of a cell of the search over a whole map, pixels


class DenseDescriber(Protocol):
    name: str
    stride: int
    channels: int
    grayscale: bool
    context_px: int

    def describe(self, image: np.ndarray) -> np.ndarray: ...


class PooledDescriber:
    """``pool``: side of a cell in those of ``dense``."""

    def __init__(self, dense: DenseDescriber, pool: int, name: str = "") -> None:
        self._dense, self._pool = dense, pool
        self.name = name or f"{dense.name}-mean-{pool}"
        self.stride, self.channels, self.grayscale = dense.stride * pool, dense.channels, dense.grayscale
        self.context_px = -(-dense.context_px // self.stride) * self.stride

    def describe(self, image: np.ndarray) -> np.ndarray:
        """(H, W, 3) uint8 BGR, or (H, W) grey -> (channels, H // stride, W // stride) float32"""
        dense = self._dense.describe(image)
        height, width = image.shape[0] // self.stride, image.shape[1] // self.stride
        cells = np.empty((self.channels, height, width), np.float32)
        for channel, into in zip(dense, cells, strict=True):
            used = channel[: height * self._pool, : width * self._pool]
            cv2.resize(used, (width, height), into, interpolation=cv2.INTER_AREA)
        return cells


class PooledGradientDescriber(PooledDescriber):
    """Eight numbers per cell, for cells of about a tenth of the height above ground."""

    name = "pooled-gradient-1"  # in map packages: increment when the descriptors of the same ground change
    channels = CHANNELS
    stride = POOL

    def __init__(self) -> None:
        super().__init__(GradientDescriber(), POOL, self.name)
