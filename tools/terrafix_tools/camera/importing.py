"""Calibrations of other programs as a camera: which program wrote a file, and what its numbers mean.

The middle of the first pixel is 0, 0, as in OpenCV, ROS and Kalibr. COLMAP, Metashape, OpenSfM and DJI count from the
corner of the first pixel or from the middle of the image; each reader says how it converts."""

import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import cv2
import msgspec
import numpy as np

from terrafix.core.errors import SourceError
from terrafix.messages import Camera
from terrafix.vision.sources.camera_info import NONE, camera_of_info, fisheye, flat_numbers, pinhole
from terrafix.vision.sources.description import NO_OMNIDIRECTIONAL

MAX_BYTES = 20_000_000  # a COLMAP model of a hundred thousand cameras [spec: any bound that no user meets]
MAX_LEFT_OUT_PX = (
    0.5  # of what OpenCV's models cannot express, at the corner [spec: below the error of a matched point]
)
# COLMAP, src/colmap/sensor/models.h: number, name, count of parameters
COLMAP_MODELS = (
    ("SIMPLE_PINHOLE", 3), ("PINHOLE", 4), ("SIMPLE_RADIAL", 4), ("RADIAL", 5), ("OPENCV", 8), ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12), ("FOV", 5), ("SIMPLE_RADIAL_FISHEYE", 4), ("RADIAL_FISHEYE", 5), ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)  # fmt: skip
# DJI writes it with the day of the calibration in front: fx, fy, cx, cy, k1, k2, p1, p2, k3
DEWARP = re.compile(r"""DewarpData(?:\s*=\s*["']|\s*>|\s*[:=]?\s*)([\d-]+;[-+\d.,eE\s]+)""")


@dataclass(frozen=True)
class Calibration:
    """``camera``: of the images that were calibrated, mount included where the file has it. ``notes``: in words, what
    was converted, assumed or left out."""

    camera: Camera
    program: str
    name: str = ""
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Wanted:
    """Options: ``which`` camera of a file of several, its ``size`` (width, height) where the file has none."""

    which: str = ""
    size: tuple[int, int] | None = None
    fisheye: bool = False  # four coefficients of OpenCV's FileStorage are those of cv2.fisheye


def read_calibration(path: Path, wanted: Wanted) -> Calibration:
    """Raises SourceError: unreadable, of no known program, or a lens that no model here describes."""
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read ({error.strerror}); name a calibration file") from None
    photo = path.suffix.lower() in (".jpg", ".jpeg", ".dng", ".tif", ".tiff")
    if len(data) > MAX_BYTES and not photo:
        raise SourceError(f"{path}: larger than {MAX_BYTES // 1_000_000} MB; name the calibration alone")
    try:
        return _read(path, data, wanted)
    except (KeyError, IndexError, TypeError, ValueError, struct.error) as error:
        what = f"has no {error}" if isinstance(error, KeyError) else str(error)
        raise SourceError(f"{path}: the calibration cannot be read ({what}); is it complete?") from None


def _read(path: Path, data: bytes, wanted: Wanted) -> Calibration:
    if path.name == "cameras.bin":
        return _of_colmap(path, list(_colmap_binary(data)), wanted)
    text = data.decode("utf-8-sig", errors="replace")
    if "DewarpData" in text:
        return _of_dji(path, data, text, wanted)
    start = text.lstrip()
    if start.startswith("%YAML:1.0") or "<opencv_storage" in start[:500]:
        return _of_opencv(path, wanted)
    if start.startswith("<"):
        return _of_metashape(path, text)
    if start.startswith("{"):
        return _of_opensfm(path, json.loads(text), wanted)
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if rows and all(len(row) > 4 and row[0].isdigit() and row[1].isupper() for row in rows):
        return _of_colmap(
            path, [(int(r[0]), r[1], int(r[2]), int(r[3]), [float(v) for v in r[4:]]) for r in rows], wanted
        )
    import yaml

    try:
        table = yaml.safe_load(text) if path.suffix in (".yaml", ".yml", "") else None
    except (yaml.YAMLError, RecursionError) as error:
        raise SourceError(f"{path}: not valid YAML ({str(error).splitlines()[0]})") from None
    if isinstance(table, dict) and any(isinstance(v, dict) and "camera_model" in v for v in table.values()):
        return _of_kalibr(path, table, wanted)
    if isinstance(table, dict) and ("distortion_model" in table or "camera_matrix" in table):
        return _of_ros(path, table)
    raise SourceError(
        f"{path}: not a calibration of a known program; known are ROS camera_info, Kalibr's camchain, OpenCV's "
        "FileStorage, COLMAP's cameras.txt and cameras.bin, cameras.json of ODM and OpenSfM, Metashape's XML, and "
        "DewarpData of DJI"
    )


def _chosen(path: Path, named: Mapping[str, Any], wanted: Wanted) -> tuple[str, Any]:
    """The one camera of a file, or the one that is asked for. Raises SourceError."""
    if wanted.which in named:
        return wanted.which, named[wanted.which]
    if wanted.which or len(named) != 1:
        what = f"has no camera '{wanted.which}'" if wanted.which else f"has {len(named)} cameras"
        raise SourceError(f"{path}: {what}; choose with --camera: {', '.join(list(named)[:20]) or 'there is none'}")
    return next(iter(named.items()))


# --- ROS --------------------------------------------------------------------------------------------------------------


def _of_ros(path: Path, table: dict[str, Any]) -> Calibration:
    camera, notes = camera_of_info(path, table)
    return Calibration(camera, "ROS camera_info", str(table.get("camera_name", "")), notes)


# --- Kalibr -----------------------------------------------------------------------------------------------------------


def _of_kalibr(path: Path, table: dict[str, Any], wanted: Wanted) -> Calibration:
    """Kalibr's camchain. T_cam_imu takes coordinates of the inertial sensor into the camera; t_imu = t_cam +
    timeshift_cam_imu."""
    cameras = {name: cam for name, cam in table.items() if isinstance(cam, dict) and "camera_model" in cam}
    name, cam = _chosen(path, cameras, wanted)
    model, lens = cam["camera_model"], cam.get("distortion_model", "none")
    if model != "pinhole":
        raise SourceError(f"{path}: camera_model {model}; {NO_OMNIDIRECTIONAL}")
    size, intrinsics, distortion = cam["resolution"], cam["intrinsics"], cam.get("distortion_coeffs") or ()
    if lens == "equidistant":
        camera: Camera = fisheye(size, intrinsics, distortion)
    elif lens in ("radtan", "none"):
        camera = pinhole(size, intrinsics, distortion)
    else:
        raise SourceError(f"{path}: distortion_model {lens}; calibrate with pinhole-radtan or pinhole-equi")
    notes = []
    if "T_cam_imu" in cam:
        camera, note = _mounted(camera, np.array(cam["T_cam_imu"], dtype=float)[:3, :3])
        notes.append(note)
    if cam.get("timeshift_cam_imu"):
        shift_s = float(cam["timeshift_cam_imu"])
        notes.append(
            f"timeshift_cam_imu {shift_s:+.4f} s: images are stamped {-1e3 * shift_s:+.1f} ms after their exposure, by "
            "the clock of the inertial sensor; the flight estimates its own time offset"
        )
    return Calibration(camera, "Kalibr", name, notes)


def _mounted(camera: Camera, r_c_imu: np.ndarray) -> tuple[Camera, str]:
    """``r_c_imu`` (3, 3): takes coordinates of the inertial sensor into the camera."""
    to_body, axes = np.eye(3), "forward, right, down"
    if r_c_imu[2, 2] < 0.0:  # the camera looks along -z of the sensor: up
        to_body, axes = np.diag([1.0, -1.0, -1.0]), "forward, left, up"
    yaw_deg, pitch_deg, roll_deg = mount_angles(to_body @ r_c_imu.T)
    mounted = msgspec.structs.replace(
        camera, mount_yaw_deg=yaw_deg, mount_pitch_deg=pitch_deg, mount_roll_deg=roll_deg, mount_tolerance_deg=1.0
    )
    return mounted, f"mount from T_cam_imu; axes of the inertial sensor, by where the camera looks: {axes}"


def mount_angles(r_b_c: np.ndarray) -> tuple[float, float, float]:
    """Rotation (3, 3) that takes camera coordinates (OpenCV's axes) into the body (forward, right, down) -> yaw, pitch,
    roll [deg] of ``core.camera.Mount``. Straight down, where yaw and roll are one, the roll is zero."""
    forward_looking = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    m = r_b_c @ forward_looking.T  # Rz(yaw) Ry(pitch) Rx(roll)
    pitch = np.arcsin(np.clip(-m[2, 0], -1.0, 1.0))
    if abs(m[2, 0]) > 1.0 - 1e-9:
        yaw, roll = np.arctan2(-m[0, 1], m[1, 1]), 0.0
    else:
        yaw, roll = np.arctan2(m[1, 0], m[0, 0]), np.arctan2(m[2, 1], m[2, 2])
    yaw_deg, pitch_deg, roll_deg = (round(float(np.degrees(v)), 4) + 0.0 for v in (yaw, pitch, roll))
    return yaw_deg, pitch_deg, roll_deg


# --- OpenCV -----------------------------------------------------------------------------------------------------------


def _of_opencv(path: Path, wanted: Wanted) -> Calibration:
    """FileStorage with the names of OpenCV's own samples, and common others."""
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    except cv2.error as error:
        raise ValueError(str(error.err)) from None
    matrix = _stored(storage, "camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M1", "mtx", "intrinsic")
    distortion = _stored(
        storage, "distortion_coefficients", "distCoeffs", "dist_coeffs", "Distortion_Coefficients", "D", "D1", "dist"
    )
    if matrix is None or matrix.shape != (3, 3):
        raise KeyError("camera_matrix")
    size = wanted.size
    for keys in (("image_width", "image_height"), ("image_Width", "image_Height"), ("width", "height")):
        found = [storage.getNode(key) for key in keys]
        if size is None and not any(node.empty() for node in found):
            size = int(found[0].real()), int(found[1].real())
    if size is None:
        raise SourceError(f"{path}: does not say of which size the images were; add --size WIDTHxHEIGHT")
    model = storage.getNode("fisheye_model")
    is_fisheye = wanted.fisheye or (bool(model.real()) if model.isInt() or model.isReal() else False)
    named = storage.getNode("distortion_model")
    is_fisheye |= named.isString() and named.string().lower() in ("fisheye", "equidistant")
    numbers = [] if distortion is None else flat_numbers(distortion)
    intrinsics = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    camera = fisheye(size, intrinsics, numbers) if is_fisheye else pinhole(size, intrinsics, numbers)
    notes = (
        [] if is_fisheye or len(numbers) != 4 else ["four coefficients are read as k1 k2 p1 p2; --fisheye otherwise"]
    )
    return Calibration(camera, "OpenCV", "", notes)


def _stored(storage: Any, *keys: str) -> np.ndarray | None:
    for key in keys:
        node = storage.getNode(key)
        if not node.empty() and node.isMap():
            return np.asarray(node.mat(), dtype=float)
    return None


# --- COLMAP -----------------------------------------------------------------------------------------------------------

ColmapRow = tuple[int, str, int, int, list[float]]


def _colmap_binary(data: bytes) -> Any:
    """Rows of cameras.bin: a count, then id, model, width, height and parameters of each, little endian."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= model < len(COLMAP_MODELS):
            raise ValueError(f"camera model {model}")
        name, length = COLMAP_MODELS[model]
        values = struct.unpack_from(f"<{length}d", data, at + 24)
        at += 24 + 8 * length
        yield number, name, width, height, list(values)


def _of_colmap(path: Path, rows: list[ColmapRow], wanted: Wanted) -> Calibration:
    """COLMAP counts from the corner of the first pixel: half a pixel is taken off the centre."""
    name, (_, model, width, height, values) = _chosen(path, {str(row[0]): row for row in rows}, wanted)
    if len(values) != dict(COLMAP_MODELS).get(model, len(values)):
        raise ValueError(f"{model} with {len(values)} parameters")
    two_focals = model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV")
    focals, rest = (values[:2], values[2:]) if two_focals else (values[:1] * 2, values[1:])
    intrinsics, size, k = (*focals, rest[0] - 0.5, rest[1] - 0.5), (width, height), rest[2:]
    if model in ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE"):
        camera: Camera = fisheye(size, intrinsics, k)
    elif model in ("SIMPLE_PINHOLE", "PINHOLE", "OPENCV", "FULL_OPENCV"):
        camera = pinhole(size, intrinsics, k)
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        camera = pinhole(size, intrinsics, (*k, 0.0, 0.0, 0.0)[:4])
    else:
        raise SourceError(f"{path}: COLMAP's model {model} is not supported; estimate OPENCV or OPENCV_FISHEYE")
    return Calibration(
        camera, f"COLMAP ({model})", name, ["half a pixel taken off the centre: COLMAP counts from the corner"]
    )


# --- ODM, OpenSfM -----------------------------------------------------------------------------------------------------


def _of_opensfm(path: Path, table: dict[str, Any], wanted: Wanted) -> Calibration:
    """Lengths in units of the longer side, from the middle of the image (opensfm/features.py:
    normalized_image_coordinates): pixel = longer side * x + (width - 1) / 2."""
    name, cam = _chosen(path, {key: value for key, value in table.items() if isinstance(value, dict)}, wanted)
    kind, width, height = cam["projection_type"], int(cam["width"]), int(cam["height"])
    longer = max(width, height)
    focal_x = float(cam["focal_x"] if "focal_x" in cam else cam["focal"])
    focal_y = float(cam.get("focal_y", focal_x))
    cx, cy = (float(cam.get(key, 0.0)) * longer + (size - 1) / 2 for key, size in (("c_x", width), ("c_y", height)))
    k1, k2, k3, k4, p1, p2 = (float(cam.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    intrinsics, size = (focal_x * longer, focal_y * longer, cx, cy), (width, height)
    if kind in ("perspective", "brown", "simple_radial", "radial"):
        camera: Camera = pinhole(size, intrinsics, (k1, k2, p1, p2, k3))
    elif kind in ("fisheye", "fisheye_opencv"):
        camera = fisheye(size, intrinsics, (k1, k2, k3, k4))
    else:
        raise SourceError(f"{path}: projection_type {kind} is not supported; use brown, perspective or fisheye_opencv")
    return Calibration(camera, f"OpenSfM ({kind})", name, ["from units of the longer side to pixels"])


# --- Metashape --------------------------------------------------------------------------------------------------------


def _of_metashape(path: Path, text: str) -> Calibration:
    """Metashape's own XML (Tools, Camera Calibration, Save; or the <calibration> of exported cameras): cx, cy from the
    middle of the image, pixels from the corner of the first, B1 = fx - f, P1 and P2 the other way round than OpenCV
    (manual, appendix D)."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise SourceError(f"{path}: not valid XML ({error})") from None
    found = [root, *root.iter("calibration")]
    table = next((node for node in reversed(found) if node.find("f") is not None), None)
    if table is None:
        raise KeyError("calibration of Metashape (f)")
    resolution = table.find("resolution")
    size = dict(resolution.attrib) if resolution is not None else {}

    def value(name: str) -> float:
        node = table.find(name)
        return float(size.get(name) or (node.text if node is not None and node.text else 0.0))

    width, height, f = value("width"), value("height"), value("f")
    node = table.find("projection")
    kind = table.get("type") or (node.text if node is not None and node.text else "frame")
    k = np.array([value(f"k{i}") for i in (1, 2, 3, 4)])
    p1, p2 = value("p1"), value("p2")
    intrinsics = (f + value("b1"), f, width / 2 + value("cx") - 0.5, height / 2 + value("cy") - 0.5)
    notes = ["half a pixel taken off the centre: Metashape counts from the corner"]
    corner = float(np.hypot(width, height) / 2 / f)  # a bound, of a lens that bends inwards
    left_out_px = abs(value("b2")) * height / 2 / f + f * corner**4 * max(abs(value("p3")), abs(value("p4")))
    if kind == "fisheye":
        camera: Camera = fisheye((width, height), intrinsics, k.tolist())
        left_out_px += 3.0 * f * corner**2 * max(abs(p1), abs(p2))
    elif kind == "frame":
        lens, off_px = _polynomial_as_opencv(k, corner, f)
        camera, left_out_px = pinhole((width, height), intrinsics, (*lens[:2], p2, p1, *lens[2:])), left_out_px + off_px
    else:
        raise SourceError(f"{path}: projection {kind} is not supported; Terrafix knows frame and fisheye")
    if left_out_px > MAX_LEFT_OUT_PX:
        raise SourceError(
            f"{path}: OpenCV's models have no skew (b2), p3 and p4, and no p1 and p2 of a fisheye; here they "
            f"move a corner by up to {left_out_px:.2g} px: optimise the cameras without them"
        )
    if left_out_px > 0.01:
        notes.append(f"left out what OpenCV's models cannot express: at most {left_out_px:.2g} px at the corner")
    return Calibration(camera, f"Metashape ({kind})", "", notes)


def _polynomial_as_opencv(k: np.ndarray, corner: float, focal_px: float) -> tuple[tuple[float, ...], float]:
    """Coefficients (4,) of r^2 to r^8 -> OpenCV's (k1, k2, k3), or with k4 the six of its rational function, by least
    squares up to the tangent ``corner``; and the largest difference in pixels."""
    if k[3] == 0.0:
        return tuple(float(v) for v in k[:3]), 0.0
    reach = corner
    for _ in range(20):  # of the ray that is seen there
        reach = min(corner / max(1.0 + float(reach ** np.array([2, 4, 6, 8]) @ k), 0.25), 4.0 * corner)
    r2 = np.linspace(0.0, reach, 200)[1:] ** 2
    powers = r2[:, None] ** [1, 2, 3]
    factor = 1.0 + np.column_stack([powers, r2**4]) @ k
    # 1 + a r^2 + b r^4 + c r^6 = factor (1 + d r^2 + e r^4 + f r^6), weighted by r
    rows = np.column_stack([powers, -factor[:, None] * powers]) * np.sqrt(r2)[:, None]
    scale = np.linalg.norm(rows, axis=0)
    found = np.linalg.lstsq(rows / scale, (factor - 1.0) * np.sqrt(r2), rcond=1e-12)[0] / scale
    rational = (1.0 + powers @ found[:3]) / (1.0 + powers @ found[3:])
    return tuple(float(v) for v in found), float(np.abs((rational - factor) * np.sqrt(r2)).max() * focal_px)


# --- DJI --------------------------------------------------------------------------------------------------------------


def _of_dji(path: Path, data: bytes, text: str, wanted: Wanted) -> Calibration:
    """DewarpData in the XMP of a photo, or as text: day; fx, fy, cx, cy, k1, k2, p1, p2, k3, the centre from the middle
    of the image (width / 2, height / 2)."""
    from terrafix.vision.sources.images import stated_size

    found = DEWARP.search(text)
    if found is None:
        raise ValueError("DewarpData has other than a day and nine numbers")
    day, _, numbers = found.group(1).partition(";")
    values = [float(v) for v in numbers.strip().strip(",").split(",")]
    if len(values) != 9:
        raise ValueError(f"DewarpData has {len(values)} numbers, not nine")
    size = wanted.size or stated_size(data)
    if size is None:
        raise SourceError(f"{path}: does not say of which size the photos are; add --size WIDTHxHEIGHT")
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = values
    flag = re.search(r"""DewarpFlag\s*(?:=\s*["']|>)\s*(\d)""", text)
    notes = [f"calibrated on {day}; the centre is from the middle of the image"]
    distortion: Sequence[float] = (k1, k2, p1, p2, k3)
    if flag and flag.group(1) == "1":
        distortion = NONE
        notes.append("DewarpFlag is 1: the camera has taken the distortion out of its photos")
    camera = pinhole(size, (fx, fy, size[0] / 2 + cx, size[1] / 2 + cy), distortion)
    return Calibration(camera, "DJI", "", notes)
