"""A crop of the map with the heading of a frame, so that map and frame can be compared by eye."""

import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame
from terrafix.map.package import LocalMap, MapPackage
from terrafix_tools.pages.pictures import VOID_BGR, jpeg_uri

MARGIN = 0.12  # around what is shown, as a share of its extent
MAX_FRAMES = 2.5  # largest width of a crop, in widths of the frame
WIDTH_PX = 680
JPEG_QUALITY = 72


@dataclass(frozen=True)
class Crop:
    """A rectangle on the ground, ``heading_rad`` up (clockwise from north). One pixel is ``gsd_m``."""

    centre_m: tuple[float, float]  # east, north
    heading_rad: float
    width_px: int
    height_px: int
    gsd_m: float

    def xy(self, ground_m: np.ndarray) -> np.ndarray:
        """East, north (N, 2) -> coordinates in the picture (N, 2), from its upper left corner."""
        right, up = ((ground_m - self.centre_m) @ axes(self.heading_rad)).T
        return np.column_stack([self.width_px / 2 + right / self.gsd_m, self.height_px / 2 - up / self.gsd_m])


def axes(heading_rad: float) -> np.ndarray:
    """(2, 2): columns are the directions right and up of a picture, in east and north."""
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[c, s], [-s, c]])


def crop_around(footprint_m: np.ndarray, estimate_m: np.ndarray, heading_rad: float) -> Crop:
    """The crop that holds the footprint (N, 2), and the estimate if that needs no more than MAX_FRAMES widths."""
    turn = axes(heading_rad)
    corners = footprint_m @ turn
    low, high = corners.min(axis=0), corners.max(axis=0)
    frame = high - low
    here = estimate_m @ turn
    wide_low, wide_high = np.minimum(low, here), np.maximum(high, here)
    if (wide_high - wide_low <= MAX_FRAMES * frame / (1 + 2 * MARGIN)).all():
        low, high = wide_low, wide_high
    centre_m = turn @ ((low + high) / 2)
    width_m, height_m = (float(v) for v in (high - low) + 2 * MARGIN * frame)
    gsd_m = width_m / WIDTH_PX
    return Crop((float(centre_m[0]), float(centre_m[1])), heading_rad, WIDTH_PX, max(1, round(height_m / gsd_m)), gsd_m)


def open_map(path: Path | None, frame: LocalFrame) -> tuple[MapPackage, LocalMap] | None:
    """None: there is no readable map."""
    if path is None:
        return None
    try:
        package = MapPackage.open(path)
    except MapError:
        return None
    return package, package.bind(frame)


def picture(crop: Crop, local: LocalMap) -> str | None:
    """The crop as a data URI; None where the map has no imagery."""
    reach_m = math.hypot(crop.width_px, crop.height_px) / 2 * crop.gsd_m
    side_px = math.ceil(2 * reach_m / crop.gsd_m)
    e_min_m, n_max_m = crop.centre_m[0] - reach_m, crop.centre_m[1] + reach_m
    image, valid = local.window(e_min_m, n_max_m, side_px, side_px, crop.gsd_m)
    if not valid.any():
        return None
    image[~valid] = VOID_BGR
    # Pixel of the crop -> pixel of the window that is north up. Rows count down, so n has the opposite sign.
    turn = axes(crop.heading_rad) @ np.diag([1.0, -1.0])
    linear = np.diag([1.0, -1.0]) @ turn
    middle = np.array([(crop.width_px - 1) / 2, (crop.height_px - 1) / 2])
    shift = np.array([(side_px - 1) / 2] * 2) - linear @ middle
    turned = cv2.warpAffine(
        image,
        np.column_stack([linear, shift]),
        (crop.width_px, crop.height_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return jpeg_uri(turned, JPEG_QUALITY)
