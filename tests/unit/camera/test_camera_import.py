"""Calibrations of other programs: each against the projection that its own program publishes, written out here."""

import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.core.errors import SourceError, UsageError
from terrafix.messages import Camera
from terrafix.vision.sources.description import camera_of, read_description
from terrafix.vision.sources.fisheye import FisheyeCamera, project
from terrafix_tools.camera.describe import describe, parse_size, resized
from terrafix_tools.camera.importing import Wanted, read_calibration

W, H = 960, 540
GRID = np.stack(np.meshgrid(np.linspace(-0.75, 0.75, 7), np.linspace(-0.45, 0.45, 5)), axis=-1).reshape(-1, 2)
RAYS = np.column_stack([GRID, np.ones(len(GRID))])
Projection = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def brown(x, y, k1, k2, p1, p2, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """wiki.ros.org/image_pipeline/CameraInfo, docs.opencv.org calib3d, colmap src/colmap/sensor/models.h (OPENCV)."""
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def equidistant(x, y, k1, k2=0.0, k3=0.0, k4=0.0):
    """Kalibr, aslam_cv EquidistantDistortion.hpp; COLMAP OPENCV_FISHEYE; opensfm camera_projections_functions.h."""
    r = np.hypot(x, y)
    t = np.arctan(r)
    scaled = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / np.where(r > 0, r, 1.0)
    return x * scaled, y * scaled


def metashape(x, y, k1, k2, k3, k4, p1, p2):
    """Agisoft Metashape user manual, appendix D, frame cameras."""
    r = np.hypot(x, y)
    radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
    return (
        x * radial + p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y,
        y * radial + p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y,
    )


def ros(model: str, numbers: list[float], **more: object) -> str:
    table = {
        "image_width": W,
        "image_height": H,
        "camera_name": "down",
        "camera_matrix": {"rows": 3, "cols": 3, "data": [561.0, 0.0, 477.5, 0.0, 559.0, 271.5, 0.0, 0.0, 1.0]},
        "distortion_model": model,
        "distortion_coefficients": {"rows": 1, "cols": len(numbers), "data": numbers},
        **more,
    }
    return f"# JSON is YAML\n{json.dumps(table)}"


def kalibr(lens: str, numbers: list[float]) -> str:
    return (
        f"cam0:\n  camera_model: pinhole\n  intrinsics: [561.0, 559.0, 477.5, 271.5]\n  distortion_model: {lens}\n"
        f"  distortion_coeffs: {numbers}\n  resolution: [{W}, {H}]\n"
    )


def opensfm(kind: str, **numbers: float) -> str:
    return json.dumps({"v2 dji 960 540": {"projection_type": kind, "width": W, "height": H, **numbers}})


def metashape_xml(kind: str, **numbers: float) -> str:
    rows = "".join(f"<{key}>{value}</{key}>" for key, value in numbers.items())
    return (
        f"<?xml version='1.0'?><calibration><projection>{kind}</projection><width>{W}</width><height>{H}</height>{rows}"
        "</calibration>"
    )


def opencv_xml(folder: Path, numbers: list[float], *, is_fisheye: bool = False) -> None:
    storage = cv2.FileStorage(str(folder / "opencv.xml"), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", W)
    storage.write("image_height", H)
    if is_fisheye:
        storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[561.0, 0.0, 477.5], [0.0, 559.0, 271.5], [0.0, 0.0, 1.0]]))
    storage.write("distortion_coefficients", np.array([numbers]))
    storage.release()


def at(fx: float, fy: float, cx: float, cy: float, distorted: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    return np.column_stack([fx * distorted[0] + cx, fy * distorted[1] + cy])


X, Y = GRID.T
K5, K8 = (-0.21, 0.06, 0.0004, -0.0007, -0.009), (0.31, 0.05, 0.0004, -0.0007, 0.004, 0.5, 0.12, 0.01)
EQUI = (0.012, -0.004, 0.003, -0.0007)
INTRINSICS = (561.0, 559.0, 477.5, 271.5)
META = (-0.11, 0.03, -0.004, 0.0009, 0.0003, -0.0005)
FRAME, META_K = {"f": 559, "cx": -2.5, "cy": 1.5}, dict(zip(("k1", "k2", "k3", "k4", "p1", "p2"), META, strict=True))
# Model, focal lengths, further parameters in COLMAP's order, and its lens
COLMAP = (
    ("SIMPLE_PINHOLE", (561,), (), (X, Y)),
    ("PINHOLE", (561, 559), (), (X, Y)),
    ("SIMPLE_RADIAL", (561,), (-0.21,), brown(X, Y, -0.21, 0, 0, 0)),
    ("RADIAL", (561,), (-0.21, 0.06), brown(X, Y, -0.21, 0.06, 0, 0)),
    ("OPENCV", (561, 559), K5[:4], brown(X, Y, *K5[:4])),
    ("FULL_OPENCV", (561, 559), K8, brown(X, Y, *K8)),
    ("SIMPLE_RADIAL_FISHEYE", (561,), (0.012,), equidistant(X, Y, 0.012)),
    ("RADIAL_FISHEYE", (561,), (0.012, -0.004), equidistant(X, Y, 0.012, -0.004)),
    ("OPENCV_FISHEYE", (561, 559), EQUI, equidistant(X, Y, *EQUI)),
)
ONE, ALL = {"focal": 0.6}, {"focal_x": 0.6, "focal_y": 0.59, "c_x": 0.01, "c_y": -0.02}
# opensfm/features.py: pixel = x max(w, h) + (w - 1) / 2; of ONE and of ALL
OPENSFM_PX = (576, 576, 479.5, 269.5), (576, 566.4, 9.6 + 479.5, -19.2 + 269.5)
OPENSFM: tuple[tuple[str, dict[str, float], dict[str, float], tuple[np.ndarray, np.ndarray]], ...] = (
    ("perspective", ONE, {"k1": -0.21, "k2": 0.06}, brown(X, Y, -0.21, 0.06, 0, 0)),
    ("radial", ALL, {"k1": -0.21, "k2": 0.06}, brown(X, Y, -0.21, 0.06, 0, 0)),
    ("brown", ALL, dict(zip(("k1", "k2", "p1", "p2", "k3"), K5, strict=True)), brown(X, Y, *K5)),
    ("fisheye", ONE, {"k1": 0.012, "k2": -0.004}, equidistant(X, Y, 0.012, -0.004)),
    ("fisheye_opencv", ALL, dict(zip(("k1", "k2", "k3", "k4"), EQUI, strict=True)), equidistant(X, Y, *EQUI)),
)
# name of the file, its text, pixels of RAYS by the program's own formula, the middle of the first pixel being 0, 0
CASES = {
    "ROS, plumb_bob": ("a.yaml", ros("plumb_bob", [*K5]), at(*INTRINSICS, brown(X, Y, *K5))),
    "ROS, rational": ("a.yaml", ros("rational_polynomial", [*K8]), at(*INTRINSICS, brown(X, Y, *K8))),
    "ROS, fisheye": ("a.yaml", ros("equidistant", [*EQUI]), at(*INTRINSICS, equidistant(X, Y, *EQUI))),
    # image_geometry/pinhole_camera_model.cpp: the region's corner off the centre, then all of it by the binning
    "ROS, region and binning": (
        "a.yaml",
        ros(
            "plumb_bob",
            [*K5],
            binning_x=2,
            binning_y=2,
            roi={"x_offset": 40, "y_offset": 20, "width": 800, "height": 500},
        ),
        at(561 / 2, 559 / 2, (477.5 - 40) / 2, (271.5 - 20) / 2, brown(X, Y, *K5)),
    ),
    "Kalibr, radtan": ("a.yaml", kalibr("radtan", [*K5[:4]]), at(*INTRINSICS, brown(X, Y, *K5[:4]))),
    "Kalibr, equidistant": ("a.yaml", kalibr("equidistant", [*EQUI]), at(*INTRINSICS, equidistant(X, Y, *EQUI))),
    **{
        f"COLMAP, {model}": (
            "cameras.txt",
            f"# Camera list\n1 {model} {W} {H} {' '.join(map(str, (*focals, 477.5, 271.5, *k)))}\n",
            at(focals[0], focals[-1], 477.5, 271.5, distorted) - 0.5,
        )
        for model, focals, k, distorted in COLMAP
    },
    **{
        f"OpenSfM, {kind}": ("cameras.json", opensfm(kind, **focals, **k), at(*OPENSFM_PX["c_x" in focals], distorted))
        for kind, focals, k, distorted in OPENSFM
    },
    # u = w / 2 + cx + x f + x B1 + y B2, from the corner of the first pixel
    "Metashape, frame": (
        "a.xml",
        metashape_xml("frame", **FRAME, b1=2.0, **{k: v for k, v in META_K.items() if k != "k4"}),
        at(561, 559, 480 - 2.5, 270 + 1.5, metashape(X, Y, *META[:3], 0.0, *META[4:])) - 0.5,
    ),
    "Metashape, frame with k4": (
        "a.xml",
        metashape_xml("frame", **FRAME, **META_K),
        at(559, 559, 480 - 2.5, 270 + 1.5, metashape(X, Y, *META)) - 0.5,
    ),
    "Metashape, fisheye": (
        "a.xml",
        metashape_xml("fisheye", **FRAME, k1=0.012, k2=-0.004, k3=0.003, k4=-0.0007),
        at(559, 559, 480 - 2.5, 270 + 1.5, equidistant(X, Y, *EQUI)) - 0.5,
    ),
    "DJI": (
        "dewarp.txt",
        'drone-dji:DewarpData="2021-05-12;561.0,559.0,-2.5,1.5,-0.21,0.06,0.0004,-0.0007,-0.009"',
        at(561, 559, 480 - 2.5, 270 + 1.5, brown(X, Y, *K5)),
    ),
}


NOTHING = Wanted()


def imported(folder: Path, name: str, text: str, wanted: Wanted = NOTHING) -> Camera:
    (folder / name).write_text(text)
    return read_calibration(folder / name, wanted).camera


def pixels(camera: Camera) -> np.ndarray:
    return project(camera, RAYS) if isinstance(camera, FisheyeCamera) else CameraCalibration.of(camera).project(RAYS)


@pytest.mark.parametrize("case", CASES)
def test_a_calibration_projects_rays_as_its_own_program_does(case: str, tmp_path: Path) -> None:
    name, text, expected = CASES[case]
    camera = imported(tmp_path, name, text, Wanted(size=(W, H)))
    assert np.abs(pixels(camera) - expected).max() < 0.01


def test_a_file_of_opencv_projects_rays_as_opencv_does(tmp_path: Path) -> None:
    """By its own functions, which the formulas above repeat."""
    matrix, still = np.array([[561.0, 0.0, 477.5], [0.0, 559.0, 271.5], [0.0, 0.0, 1.0]]), np.zeros(3)
    for numbers, is_fisheye, formula in (([*K5], False, brown), ([*K8], False, brown), ([*EQUI], True, equidistant)):
        opencv_xml(tmp_path, numbers, is_fisheye=is_fisheye)
        camera, distorted = read_calibration(tmp_path / "opencv.xml", Wanted()).camera, np.array(numbers)
        seen = (cv2.fisheye if is_fisheye else cv2).projectPoints(RAYS[:, None], still, still, matrix, distorted)
        assert np.abs(pixels(camera) - seen[0][:, 0]).max() < 0.01
        assert np.abs(at(*INTRINSICS, formula(X, Y, *numbers)) - seen[0][:, 0]).max() < 1e-6


def test_cameras_bin_is_read_as_cameras_txt(tmp_path: Path) -> None:
    row = struct.pack("<iiQQ8d", 7, 4, W, H, 561, 559, 477.5, 271.5, -0.21, 0.06, 0.0004, -0.0007)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 1) + row)
    name, text, _ = CASES["COLMAP, OPENCV"]
    assert read_calibration(tmp_path / "cameras.bin", Wanted()).camera == imported(tmp_path, name, text)


@pytest.mark.parametrize("up", [False, True])
def test_the_transform_of_kalibr_is_the_mount(up: bool, tmp_path: Path) -> None:
    """Axes of the autopilot (forward, right, down), and with those of ROS (forward, left, up)."""
    mount = Mount(yaw_deg=90.0, pitch_deg=-70.0, roll_deg=3.0)
    r_c_imu = mount.r_b_c().T @ (np.diag([1.0, -1.0, -1.0]) if up else np.eye(3))
    transform = np.vstack([np.column_stack([r_c_imu, [0.1, 0.0, 0.0]]), [0.0, 0.0, 0.0, 1.0]])
    text = kalibr("radtan", [*K5[:4]]) + f"  T_cam_imu: {transform.tolist()}\n  timeshift_cam_imu: 0.012\n"
    (tmp_path / "a.yaml").write_text(text)
    found = read_calibration(tmp_path / "a.yaml", Wanted())
    assert np.abs(Mount.of(found.camera).r_b_c() - mount.r_b_c()).max() < 1e-5
    assert any("stamped -12.0 ms after" in note for note in found.notes)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("a.yaml", kalibr("radtan", [0.0] * 4).replace("pinhole", "omni"), "omnidirectional"),
        ("a.yaml", kalibr("fov", [0.9]), "pinhole-equi"),
        ("a.yaml", ros("plumb_bob", [0.0] * 5).replace("561.0", "0.0"), "not calibrated"),
        ("a.yaml", "a: [1, 2", "not valid YAML"),
        ("a.yaml", "width: 3", "not a calibration of a known program"),
        ("a.toml", "[camera]", "not a calibration of a known program"),
        ("cameras.txt", f"1 FOV {W} {H} 561 559 477.5 271.5 0.9\n", "FOV is not supported"),
        ("cameras.txt", f"1 PINHOLE {W} {H} 561 559\n", "cannot be read"),
        ("cameras.txt", CASES["COLMAP, OPENCV"][1] + f"2 PINHOLE {W} {H} 561 559 477.5 271.5\n", "--camera: 1, 2"),
        ("cameras.json", opensfm("spherical", focal=0.0), "spherical is not supported"),
        ("cameras.json", opensfm("brown", focal_y=0.6), "has no 'focal'"),
        ("a.xml", metashape_xml("frame", f=559, cx=0, cy=0, b2=4.0), "skew"),
        ("a.xml", "<calibration>", "not valid XML"),
        ("d.txt", 'DewarpData="2021-05-12;561.0,559.0"', "nine"),
        ("d.txt", CASES["DJI"][1], "--size"),
    ],
)
def test_what_cannot_be_imported_is_refused_in_one_line(name: str, text: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=problem) as error:
        imported(tmp_path, name, text)
    assert "\n" not in str(error.value)


def test_the_written_description_is_what_was_imported_and_a_bad_one_replaces_nothing(tmp_path: Path) -> None:
    name, text, expected = CASES["Kalibr, equidistant"]
    out = tmp_path / "camera.toml"
    lines = list(describe(out, imported(tmp_path, name, text), "cam0", ["From a.yaml."]))
    camera = camera_of(out, read_description(out))
    assert np.abs(pixels(camera) - expected).max() < 0.01
    assert any("focal length 561.0" in line for line in lines)
    wrong = imported(tmp_path, name, text.replace("561.0, 559.0", "5.0, 5.0"))
    with pytest.raises(SourceError, match="more than half a turn"):
        list(describe(out, wrong, "cam0", []))
    assert camera_of(out, read_description(out)) == camera


def test_a_calibration_is_scaled_to_the_frames_that_fly_and_not_to_another_aspect(tmp_path: Path) -> None:
    name, text, expected = CASES["Kalibr, radtan"]
    camera = imported(tmp_path, name, text)
    half = resized(Path(name), camera, parse_size("480x270"))
    assert np.abs((pixels(half) + 0.5) * 2 - 0.5 - expected).max() < 0.01
    with pytest.raises(UsageError, match="another aspect"):
        resized(Path(name), camera, (640, 480))
    with pytest.raises(UsageError, match="WIDTHxHEIGHT"):
        parse_size("large")
