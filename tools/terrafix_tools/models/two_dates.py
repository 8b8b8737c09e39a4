"""Views of one image over the map of another date: camera frames with known positions, unknown headings."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import MapError
from terrafix.core.geodesy import LocalFrame, local_crs
from terrafix.core.node import Image
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.mapping.check.sight import NORTH_UP, TILT_SIGMA_RAD
from terrafix_tools.mapping.source import ImagerySource

CAMERA = CameraCalibration(640, 480, 554.0, 554.0, 319.5, 239.5)  # 60 degrees wide
HEIGHT_ERROR = 0.03  # largest relative error of the height that the view states
MARGIN = 0.75  # heights: least distance of a place from the border; the corner of a frame is 0.72 away
EMPTY_SHARE = 0.02  # largest share of a frame without imagery, in either image
MAX_DRAWS = 10_000


@dataclass(frozen=True)
class TrueView:
    """A frame, its true place (local east, north) and heading (clockwise from north), and the prediction for it."""

    frame: Image
    place_m: np.ndarray
    heading_rad: float
    predicted: View


class TwoDates:
    """A camera over ``first``; the map is ``second``, in the same coordinate system. Raises MapError."""

    def __init__(self, first: Path, second: Path) -> None:
        self._camera_image, self._map_image = same_grid(first, second)
        with ImagerySource(second) as source:
            crs_from_px, crs = source.transform, source.crs
        height, width = self._camera_image.shape[:2]
        lon_deg, lat_deg = Transformer.from_crs(crs, 4326, always_xy=True).transform(
            *(crs_from_px @ (width / 2, height / 2))
        )
        self.origin = LocalFrame(lat_deg, lon_deg)
        self.package_path = ensure_package(second, map_cache_dir())
        to_local = Transformer.from_crs(crs, local_crs(lat_deg, lon_deg), always_xy=True)
        corners_px = np.array([[0.0, 0.0], [width, 0.0], [0.0, height]])
        corners_m = np.array([to_local.transform(*(crs_from_px @ tuple(px))) for px in corners_px])
        # least-squares affine map: exact at three corners, a fraction of a pixel off in the fourth
        self._origin_m = corners_m[0]
        self._local_from_px = np.column_stack(
            [(corners_m[1] - corners_m[0]) / width, (corners_m[2] - corners_m[0]) / height]
        )
        self._px_from_local = np.linalg.inv(self._local_from_px)

    def open(self) -> tuple[LocalMap, FrameMatcher]:
        """A new reader of the map, without any cached descriptors."""
        local = MapPackage.open(self.package_path).bind(self.origin)
        return local, FrameMatcher(CAMERA, local, GradientDescriber())

    def draw(self, count: int, agl_m: float, seed: int) -> Iterator[TrueView]:
        """``count`` views at random places and headings. Raises MapError: too little ground is on both images."""
        rng = np.random.default_rng(seed)
        height, width = self._map_image.shape[:2]
        pixel_m = math.sqrt(abs(float(np.linalg.det(self._local_from_px))))
        rim_px = MARGIN * agl_m / pixel_m
        if 2 * rim_px >= min(height, width):
            raise MapError(f"the images are too small for frames at {agl_m:g} m; give a smaller height")
        drawn = 0
        for _ in range(MAX_DRAWS):
            if drawn == count:
                return
            px = rng.uniform([rim_px, rim_px], [width - rim_px, height - rim_px])
            heading_rad, error = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-HEIGHT_ERROR, HEIGHT_ERROR)
            place_m = self._origin_m + self._local_from_px @ px
            views = [self._view(image, place_m, heading_rad, agl_m) for image in (self._camera_image, self._map_image)]
            if max(float(np.mean(v.max(axis=2) == 0)) for v in views) > EMPTY_SHARE:
                continue
            drawn += 1
            stated_m = agl_m * (1.0 + error)
            predicted = View(0.0, 0.0, NORTH_UP, stated_m, 0.0, math.pi, HEIGHT_ERROR / math.sqrt(3.0), TILT_SIGMA_RAD)
            yield TrueView(views[0], place_m, heading_rad, predicted)
        raise MapError("the two images have too little ground in common; choose larger ones")

    def _view(self, image: np.ndarray, place_m: np.ndarray, heading_rad: float, agl_m: float) -> Image:
        """``image`` as a camera at a place sees it that looks straight down, the top of its frame towards the
        heading."""
        cos, sin = math.cos(heading_rad), math.sin(heading_rad)
        # columns: ground metres (east, north) of one frame pixel to the right and down
        local_from_frame = np.array([[cos, -sin], [-sin, -cos]]) * agl_m / CAMERA.fx
        matrix = np.empty((2, 3))
        matrix[:, :2] = self._px_from_local @ local_from_frame
        centre_px = self._px_from_local @ (place_m - self._origin_m) - 0.5  # integers are pixel centres
        matrix[:, 2] = centre_px - matrix[:, :2] @ (CAMERA.cx, CAMERA.cy)
        size = (CAMERA.width, CAMERA.height)
        return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP))


def same_grid(first: Path, second: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns both images on the grid of the second one, (H, W, 3) uint8 BGR."""
    with ImagerySource(first) as one, ImagerySource(second) as two:
        if one.crs != two.crs:
            raise MapError(f"{first}: another coordinate system than {second}; bring it into that one with gdalwarp")
        camera, ground = (image.read(0, 0, image.width_px, image.height_px)[0] for image in (one, two))
        wider, higher = one.pixel_x / two.pixel_x, one.pixel_y / two.pixel_y
        east_px, south_px = (one.x_min - two.x_min) / two.pixel_x, (two.y_max - one.y_max) / two.pixel_y
        # The geotransform refers to pixel corners; OpenCV's coordinates to pixel centres.
        matrix = np.array([[wider, 0, east_px + 0.5 * wider - 0.5], [0, higher, south_px + 0.5 * higher - 0.5]])
    return cv2.warpAffine(camera, matrix, (ground.shape[1], ground.shape[0]), flags=cv2.INTER_LINEAR), ground
