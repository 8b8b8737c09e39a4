"""A fisheye lens: the pinhole view of its images, against an independent projection of it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import SourceError
from terrafix.messages import Camera
from terrafix.vision.sources import open_source
from terrafix.vision.sources.description import camera_of, read_description
from terrafix.vision.sources.facts import facts_of
from terrafix.vision.sources.fisheye import VIEW_HALF_DEG, FisheyeCamera, project, view_of
from terrafix_lab.sim.camera.lens import Fisheye, lens_of

LENS = Fisheye(640, 480, 240.0, 242.0, 322.0, 236.0, (0.01, 0.004, -0.002, 0.0003))
CAMERA = """[camera]
model = "fisheye"
width = 640
height = 480
fx = 240.0
fy = 242.0
cx = 322.0
cy = 236.0
distortion = [0.01, 0.004, -0.002, 0.0003]
"""


def described(folder: Path, text: str) -> Camera:
    (folder / "camera.toml").write_text(text)
    return camera_of(folder / "camera.toml", read_description(folder / "camera.toml"))


def spots(px: np.ndarray, width: int, height: int) -> np.ndarray:
    """An image with a soft spot at each of the pixels (N, 2)."""
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    near = ((px[:, 0, None, None] - x) ** 2 + (px[:, 1, None, None] - y) ** 2).min(axis=0)
    return np.repeat((255 * np.exp(-near / 18.0)).astype(np.uint8)[..., None], 3, axis=2)


def test_a_ray_that_a_fisheye_images_is_where_the_pinhole_view_projects_it(tmp_path: Path) -> None:
    away = np.radians([0.0, 20.0, 40.0, 50.0])
    round_ = np.radians([10.0, 100.0, 190.0, 285.0])
    rays = np.column_stack([np.sin(away) * np.cos(round_), np.sin(away) * np.sin(round_), np.cos(away)])
    (tmp_path / "frames").mkdir()
    cv2.imwrite(str(tmp_path / "frames" / "1.png"), spots(LENS.project(rays), LENS.width, LENS.height))
    (tmp_path / "frames.csv").write_text("file,t_s\n1.png,0\n")
    (tmp_path / "flight.toml").write_text(CAMERA)
    source = open_source(str(tmp_path), start=(1.0, 2.0))
    (shot,), camera = source.shots(), source.origin().camera
    assert shot.image is not None
    assert shot.image.shape[:2] == (camera.height, camera.width) == (shot.frame.height, shot.frame.width)
    assert camera.fx == 240.0  # the resolution in the middle
    for x, y in CameraCalibration.of(camera).project(rays):
        patch = shot.image[round(y) - 9 : round(y) + 10, round(x) - 9 : round(x) + 10, 0].astype(float)
        down, right = np.unravel_index(np.argmax(patch), patch.shape)
        assert abs(right - 9) <= 1 and abs(down - 9) <= 1
        assert patch.max() > 200
    assert any("fisheye, of which 110 x 110 degrees are used" in fact.text for fact in facts_of(source))


def test_the_simulated_camera_and_opencv_project_a_described_fisheye_alike(tmp_path: Path) -> None:
    camera = described(tmp_path, CAMERA)
    assert isinstance(camera, FisheyeCamera)
    rays = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 1.0], [-2.0, 1.0, 1.0], [3.0, 3.0, 0.5]])
    assert np.abs(lens_of(camera).project(rays) - project(camera, rays)).max() < 1e-6


@pytest.mark.parametrize("fov_deg", [180.0, 100.0])
def test_the_view_lies_in_the_image_and_in_the_circle_of_the_lens(fov_deg: float) -> None:
    whole = FisheyeCamera(
        width=640, height=480, fx=170.0, fy=170.0, cx=322.0, cy=236.0, distortion=(0.02, 0.0, 0.0, 0.0), fov_deg=fov_deg
    )
    view = view_of(whole)
    lens = Fisheye(640, 480, 170.0, 170.0, 322.0, 236.0, (0.02, 0.0, 0.0, 0.0))
    x, y = np.meshgrid(np.arange(view.width), np.arange(view.height))
    rays = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones(x.shape)], axis=-1).reshape(-1, 3)
    px = lens.project(rays)
    assert px.min() >= 0.0 and (px <= (639.0, 479.0)).all()
    off_axis_deg = np.degrees(np.arctan(np.hypot(rays[:, 0], rays[:, 1])))
    assert off_axis_deg.max() <= fov_deg / 2 + 0.1
    assert off_axis_deg.max() > min(fov_deg / 2, VIEW_HALF_DEG) - 2.0


def test_a_polynomial_that_turns_back_bounds_the_view() -> None:
    """r = t - 0.5 t^3 has its largest value at 47 degrees."""
    folds = FisheyeCamera(width=640, height=480, fx=240.0, fy=240.0, cx=320.0, cy=240.0, distortion=(-0.5, 0, 0, 0))
    view = view_of(folds)
    assert np.degrees(np.arctan(view.cx / view.fx)) < 47.0


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ('model = "omni"', "omnidirectional lenses"),
        ("distortion = [0.01, 0.004]", "a fisheye has k1, k2, k3, k4"),
        ("fov_deg = 0", "fov_deg"),
    ],
)
def test_a_lens_that_is_not_known_is_refused_in_one_line(line: str, problem: str, tmp_path: Path) -> None:
    key = line.split(" = ", maxsplit=1)[0]
    text = "\n".join(row for row in CAMERA.splitlines() if not row.startswith(key)) + f"\n{line}\n"
    with pytest.raises(SourceError, match=problem) as error:
        described(tmp_path, text)
    assert "\n" not in str(error.value)


def test_rays_of_a_wide_distorted_lens_are_exact_at_its_edge() -> None:
    lens = CameraCalibration(1920, 1080, 940.0, 940.0, 960.0, 540.0, (-0.28, 0.09, 0.0, 0.0, -0.012))
    rays = np.array([[np.tan(np.radians(45.0)), 0.2, 1.0]])
    x, y = rays[0, :2]
    r2 = x * x + y * y
    factor = 1.0 + r2 * (-0.28 + r2 * (0.09 + r2 * -0.012))
    px = np.array([[960.0 + 940.0 * factor * x, 540.0 + 940.0 * factor * y]])
    assert 940.0 * np.abs(lens.normalise(px) - rays[:, :2]).max() < 0.01
