"""Cameras from the numbers of a calibration: sensor_msgs/CameraInfo, as files and bags of ROS have it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import Camera
from terrafix.vision.sources.description import CALIBRATED_FOCAL_SIGMA, DISTORTION_LENGTHS, NO_OMNIDIRECTIONAL
from terrafix.vision.sources.fisheye import FisheyeCamera

NONE = (0.0, 0.0, 0.0, 0.0)  # a calibrated lens without distortion


def pinhole(size: Sequence[float], intrinsics: Sequence[float], distortion: Sequence[float]) -> Camera:
    """``size``: width, height; ``intrinsics``: fx, fy, cx, cy; ``distortion`` in OpenCV's order, () for none."""
    return Camera(**_fields(size, intrinsics, distortion or NONE))


def fisheye(size: Sequence[float], intrinsics: Sequence[float], distortion: Sequence[float]) -> FisheyeCamera:
    """``distortion``: up to k1, k2, k3, k4 of Kannala and Brandt."""
    return FisheyeCamera(**_fields(size, intrinsics, (*distortion, *NONE)[:4]))


def _fields(size: Sequence[float], intrinsics: Sequence[float], distortion: Sequence[float]) -> dict[str, Any]:
    (width, height), (fx, fy, cx, cy) = (int(v) for v in size), (float(v) for v in intrinsics)
    numbers = tuple(float(v) for v in distortion)
    if not np.isfinite([fx, fy, cx, cy, *numbers]).all() or fx <= 0.0 or fy <= 0.0:
        raise ValueError(f"a focal length of {fx:g}, {fy:g}: it is not calibrated")
    if len(numbers) not in DISTORTION_LENGTHS:
        raise ValueError(f"{len(numbers)} coefficients of distortion")
    return {
        "width": width,
        "height": height,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "distortion": numbers,
        "focal_sigma": CALIBRATED_FOCAL_SIGMA,
    }


def flat_numbers(value: Any) -> list[float]:
    """Of a matrix with ``data``, or a list, nested or not."""
    data = value["data"] if isinstance(value, dict) else value
    return [float(v) for v in np.asarray(data, dtype=float).reshape(-1)]


def camera_of_info(path: Path, table: dict[str, Any]) -> tuple[Camera, list[str]]:
    """sensor_msgs/CameraInfo, of camera_calibration (camera_matrix) or as `ros2 topic echo` prints it (k, d). K and D
    are of the whole image; of a region, and of binned pixels, image_geometry makes cx - x_offset and cx / binning.

    -> camera without its mount, and in words what was converted. Raises SourceError: another model; KeyError,
    ValueError: not calibrated."""
    matrix = flat_numbers(next(table[key] for key in ("camera_matrix", "K", "k") if key in table))
    distortion = flat_numbers(next((table[key] for key in ("distortion_coefficients", "D", "d") if key in table), []))
    width, height = (
        table.get("image_width", table.get("width")),
        table.get("image_height", table.get("height")),
    )
    if width is None or height is None:
        raise KeyError("image_width and image_height")
    notes, roi = [], table.get("roi") or {}
    by_x, by_y = (max(int(table.get(key) or 1), 1) for key in ("binning_x", "binning_y"))
    left, top = int(roi.get("x_offset") or 0), int(roi.get("y_offset") or 0)
    if left or top or roi.get("width"):
        width, height = roi.get("width") or width - left, roi.get("height") or height - top
        notes.append(f"region of interest: {width}x{height} px from {left}, {top} on")
    if by_x > 1 or by_y > 1:
        width, height = width // by_x, height // by_y
        notes.append(f"binning {by_x} x {by_y}: centre divided by it, as image_geometry does")
    fx, _, cx, _, fy, cy = matrix[:6]
    intrinsics = (fx / by_x, fy / by_y, (cx - left) / by_x, (cy - top) / by_y)
    model = str(table.get("distortion_model", "plumb_bob")).lower()
    if model in ("equidistant", "fisheye", "kannala_brandt4"):
        camera: Camera = fisheye((width, height), intrinsics, distortion[:4])
    elif model in ("plumb_bob", "rational_polynomial", "radtan", "none", ""):
        camera = pinhole((width, height), intrinsics, distortion)
    else:
        raise SourceError(f"{path}: distortion_model {model}; {NO_OMNIDIRECTIONAL}")
    return camera, notes
