"""Coarse grid of rays over a frame: interpolation between its points, and image look-up at them."""

import math
from collections.abc import Callable, Iterator

import cv2
import numpy as np

from terrafix_lab.sim.ground.tiles import TOP_LEVEL, Pyramid, level_for

GRID_PX = 16  # spacing; a divisor of 32, so that OpenCV's fixed-point weights are exact at every pixel
LARGEST_WINDOW_PX = 4096  # of a side; a larger window is sampled at a coarser level

Block = tuple[slice, slice]  # rows and columns
Dense = Callable[[np.ndarray], np.ndarray]  # values at grid points -> at pixels, float32


class Grid:
    """Points every GRID_PX pixels; the last ones are at or beyond the edge of the frame."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self.shape = math.ceil((height - 1) / GRID_PX) + 1, math.ceil((width - 1) / GRID_PX) + 1
        self.row_px = np.arange(self.shape[0]) * float(GRID_PX)
        x, y = np.meshgrid(np.arange(self.shape[1]) * float(GRID_PX), self.row_px)
        self.px = np.stack([x, y], axis=-1).reshape(-1, 2)  # (rows x columns, 2)
        across, down = np.arange(width, dtype=np.float32) / GRID_PX, np.arange(height, dtype=np.float32) / GRID_PX
        self._x, self._y = np.meshgrid(across, down)

    def dense(self, coarse: np.ndarray, size: tuple[int, ...] | None = None) -> np.ndarray:
        """Interpolates values at grid points to pixels (height, width) from the first point on, float32; ``size``
        None: the frame.
        """
        height, width = size or (self.height, self.width)
        at = self._x[:height, :width], self._y[:height, :width]
        values = np.ascontiguousarray(coarse, np.float32)
        return cv2.remap(values, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    def projective(self, nearness: np.ndarray, size: tuple[int, ...]) -> Dense:
        """``dense`` for an oblique view: on a plane, values times nearness (1 / distance) are linear in the image."""
        weight = self.dense(nearness, size)
        return lambda coarse: self.dense(coarse * nearness, size) / weight

    def blocks(self, cells: int) -> Iterator[tuple[Block, Block]]:
        """Splits the frame in blocks of ``cells`` grid cells a side; yields their pixels and their grid points."""
        step = cells * GRID_PX
        for y in range(0, self.height, step):
            for x in range(0, self.width, step):
                pixels = slice(y, min(y + step, self.height)), slice(x, min(x + step, self.width))
                j, i = y // GRID_PX, x // GRID_PX
                yield pixels, (slice(j, j + cells + 1), slice(i, i + cells + 1))


def cell_steps(x: np.ndarray, y: np.ndarray, spacing_px: int) -> np.ndarray:
    """Returns the ground distance per image pixel in the cells (rows - 1, columns - 1) between points."""
    across = np.diff(x, axis=1)[:-1] * np.diff(y, axis=0)[:, :-1]
    down = np.diff(y, axis=1)[:-1] * np.diff(x, axis=0)[:, :-1]
    return np.sqrt(np.abs(across - down)) / spacing_px


def sample_image(pyramid: Pyramid, x: np.ndarray, y: np.ndarray, step_px: float, dense: Dense) -> np.ndarray:
    """Samples an image at level-0 positions ``x``, ``y``, which ``dense`` interpolates to every pixel: (H, W[, 3])
    uint8.

    ``step_px``: distance of neighbouring samples, which determines the level.
    """
    level = level_for(step_px)
    while level < TOP_LEVEL and max(np.ptp(x), np.ptp(y)) / 2**level > LARGEST_WINDOW_PX:
        level += 1
    x, y = (x + 0.5) / 2**level - 0.5, (y + 0.5) / 2**level - 0.5
    left, top = math.floor(x.min()) - 1, math.floor(y.min()) - 1
    width, height = math.ceil(x.max()) + 3 - left, math.ceil(y.max()) + 3 - top
    window = pyramid.window(level, left, top, min(width, 2 * LARGEST_WINDOW_PX), min(height, 2 * LARGEST_WINDOW_PX))
    return cv2.remap(window, dense(x - left), dense(y - top), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
