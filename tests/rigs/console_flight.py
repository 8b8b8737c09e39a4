"""Photos of a flight over generated ground, and the map of that ground, for flights over HTTP."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from pyproj import Transformer

import map_rasters
from terrafix.core.camera import CameraCalibration
from terrafix_tools.mapping.build import build
from textured_ground import GSD_M, SIDE_M, rotation, texture, view

CAMERA = CameraCalibration(640, 480, 380.0, 380.0, 319.5, 239.5)
AGL_M, STEP_M = 80.0, 35.0
GROUND, ELSEWHERE = 3, 8  # seeds of the ground of the map, and of another one
TO_WGS84 = Transformer.from_crs(32651, 4326, always_xy=True)


def place_of(i: int) -> np.ndarray:
    """East and north of frame ``i`` from the middle of the map."""
    return np.array([-170.0 + STEP_M * (i % 10), 60.0 - 100.0 * (i // 10)])


def lat_lon(place_m: np.ndarray) -> tuple[float, float]:
    lon, lat = TO_WGS84.transform(300_000.0 + SIDE_M / 2 + place_m[0], 2_600_000.0 - SIDE_M / 2 + place_m[1])
    return lat, lon


@cache
def ground(seed: int) -> np.ndarray:
    return texture(seed)


def write_images(folder: Path, frames: range, seed: int) -> list[tuple[str, Path]]:
    """Names and files of the images of frames ``frames``, over the ground ``seed``."""
    written = []
    for i in frames:
        path = folder / f"IMG_{i:04d}.jpg"
        image = view(ground(seed), CAMERA, rotation(90.0), np.array([*place_of(i), AGL_M]))
        cv2.imwrite(str(path), image, [cv2.IMWRITE_JPEG_QUALITY, 90])
        written.append((path.name, path))
    return written


def make_map(folder: Path) -> None:
    """ground.gpkg, the map of GROUND, in ``folder``."""
    folder.mkdir(exist_ok=True)
    bands = np.ascontiguousarray(ground(GROUND)[..., ::-1].transpose(2, 0, 1))
    build(map_rasters.utm(folder / "ground.tif", bands, pixel_m=GSD_M), folder / "ground.gpkg")


def distance_m(at: tuple[float, float], place_m: np.ndarray) -> float:
    lat, lon = lat_lon(place_m)
    return float(np.hypot((at[0] - lat) * 110_750.0, (at[1] - lon) * 111_320.0 * np.cos(np.radians(lat))))
