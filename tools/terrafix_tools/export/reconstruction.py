"""Poses and camera for structure from motion: COLMAP's text model, OpenSfM's reconstruction.json.

Both count pixels from the corner of the image, so that the middle of the first one is 0.5, 0.5."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pyproj import Transformer

from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame, quat_from_rot
from terrafix.messages import Camera
from terrafix_tools.export.photogrammetry import one_word
from terrafix_tools.export.track import Track, TrackPose, camera_of

RATIONAL = 8  # coefficients of OpenCV's rational model: k1 k2 p1 p2 k3 k4 k5 k6


def write_colmap(track: Track, out: Path, photos: Path | None) -> None:
    """https://colmap.github.io/format.html: cameras.txt, images.txt (without features), points3D.txt (empty). Raises
    UsageError, SourceError."""
    camera, poses = camera_of(track, photos), track.oriented()
    k1, k2, p1, p2, k3, *higher = _coefficients(camera, RATIONAL)
    numbers: list[float] = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    model = "PINHOLE"
    if k3 or any(higher):
        model, numbers = "FULL_OPENCV", [*numbers, k1, k2, p1, p2, k3, *higher]
    elif any((k1, k2, p1, p2)):
        model, numbers = "OPENCV", [*numbers, k1, k2, p1, p2]
    parameters = " ".join(f"{value:.10g}" for value in numbers)
    images = [f"# world: east, north [m] of {_text(track.axes)} (latitude, longitude); up: above mean sea level\n"]
    for number, pose in enumerate(poses, 1):
        r_c_w, t = _world_to_camera(pose, track.position_m(pose))
        values = " ".join(f"{value:.9f}" for value in (*quat_from_rot(r_c_w), *t))
        images.append(f"{number} {values} 1 {one_word(pose.name)}\n\n")
    out.mkdir(parents=True, exist_ok=True)
    (out / "cameras.txt").write_text(f"1 {model} {camera.width} {camera.height} {parameters}\n", encoding="ascii")
    (out / "images.txt").write_text("".join(images), encoding="utf-8")
    (out / "points3D.txt").write_text("", encoding="ascii")


def write_opensfm(track: Track, out: Path, photos: Path | None) -> None:
    """https://opensfm.org/docs/dataset.html: one reconstruction about the origin of the flight, without points. World:
    topocentric east, north, up. Raises UsageError, SourceError."""
    camera, poses = camera_of(track, photos), track.oriented()
    k1, k2, p1, p2, k3 = _coefficients(camera, 5)
    size = max(camera.width, camera.height)
    name = f"terrafix {camera.width} {camera.height} brown"
    topocentric = Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 +step "
        f"+proj=topocentric +ellps=WGS84 +lat_0={track.axes.lat_deg:.9f} +lon_0={track.axes.lon_deg:.9f} +h_0=0"
    )
    shots: dict[str, Any] = {}
    for pose in poses:
        up_m = track.position_m(pose)[2]
        position = np.array(topocentric.transform(pose.lon_deg, pose.lat_deg, up_m))
        r_c_w, t = _world_to_camera(pose, position)
        shots[pose.name] = {
            "camera": name,
            "rotation": cv2.Rodrigues(r_c_w)[0].ravel().tolist(),
            "translation": t.tolist(),
            "orientation": 1,
            "capture_time": pose.row.t_s if pose.unix_s is None else pose.unix_s,
            "gps_position": position.tolist(),
            "gps_dop": pose.sigma_h_m or 0.0,
        }
    lens = {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    centre = {
        "c_x": (camera.cx + 0.5 - camera.width / 2) / size,
        "c_y": (camera.cy + 0.5 - camera.height / 2) / size,
    }
    described = {
        "projection_type": "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": camera.fx / size,
        "focal_y": camera.fy / size,
        **centre,
        **lens,
    }
    reference = {"latitude": track.axes.lat_deg, "longitude": track.axes.lon_deg, "altitude": 0.0}
    whole = [{"cameras": {name: described}, "shots": shots, "points": {}, "reference_lla": reference}]
    out.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


def _coefficients(camera: Camera, count: int) -> tuple[float, ...]:
    """The first ``count`` coefficients in OpenCV's order. Raises UsageError: the lens has more."""
    if any(camera.distortion[count:]):
        raise UsageError(f"the lens has {len(camera.distortion)} coefficients of distortion, and this format {count}")
    return (*camera.distortion[:count], *(0.0,) * (count - len(camera.distortion)))


def _world_to_camera(pose: TrackPose, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> R (3, 3) and t (3,) of p_camera = R p_world + t."""
    assert pose.r_w_c is not None
    return pose.r_w_c.T, -pose.r_w_c.T @ position


def _text(axes: LocalFrame) -> str:
    return f"{axes.lat_deg:.9f}, {axes.lon_deg:.9f}"
