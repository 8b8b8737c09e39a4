"""Fine texture of the ground, finer than the resolution of maps. It is not periodic: repeated ground would produce
false matches.
"""

import math

import cv2
import numpy as np

from terrafix_lab.sim.ground.tiles import TILE_PX, Pyramid
from terrafix_lab.sim.world.noise import white

DETAIL_M = 0.15  # metres a pixel
NEUTRAL = 128  # value of factor 1
# (sigma of a smoothing, weight): structure of clods and tufts without larger patches
GRAINS_PX = ((0.8, 1.0), (1.6, 1.0), (4.0, -0.5))
BORDER_PX = 16  # reach of the widest smoothing
CACHE_BYTES = 48 << 20


def detail(seed: int, contrast: float) -> Pyramid:
    """Returns the texture as brightness factors, NEUTRAL = 1: tiles (TILE_PX, TILE_PX) uint8, DETAIL_M a pixel."""

    def make(level: int, i: int, j: int) -> np.ndarray | None:
        if level > 0:
            return None
        size = TILE_PX + 2 * BORDER_PX
        grain = white(seed, i * TILE_PX - BORDER_PX, j * TILE_PX - BORDER_PX, size, size)
        out = np.zeros_like(grain)
        for sigma_px, weight in GRAINS_PX:
            # smoothing divides the standard deviation of white noise by this
            unit = 2.0 * math.sqrt(math.pi) * sigma_px
            cv2.scaleAdd(cv2.GaussianBlur(grain, (0, 0), sigma_px), weight * unit, out, out)
        inside = out[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
        return np.clip(NEUTRAL * (1.0 + contrast * inside) + 0.5, 0, 255).astype(np.uint8)

    return Pyramid(make, CACHE_BYTES)
