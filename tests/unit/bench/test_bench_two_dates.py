"""Benchmark of single frames on imagery of another date: acceptance, prediction, and covariance of the centre point."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from rasterio.transform import Affine

import map_rasters
from terrafix.core.errors import MapError
from terrafix.core.geodesy import quat_from_rot, rot_from_quat
from terrafix.core.pose import exp_so3
from terrafix.messages import MapMatch, MapPose, Verdict
from terrafix_tools.bench.two_dates import FOCAL_PX, Places, centre_point_of, measure, row
from textured_ground import texture


@pytest.fixture(scope="module")
def dates(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two images of the same ground; the second one is darker and begins 30 px further east."""
    folder = tmp_path_factory.mktemp("dates")
    ground = np.ascontiguousarray(texture(6, 300.0)[:880])
    first = map_rasters.utm(folder / "first.tif", ground[:, :, ::-1].transpose(2, 0, 1))
    later = cv2.convertScaleAbs(ground[:, 30:], alpha=0.8)[:, :, ::-1].transpose(2, 0, 1)
    moved = Affine(0.5, 0, 300_015.0, 0, -0.5, 2_600_000.0)
    return first, map_rasters.write_tif(folder / "second.tif", later, "EPSG:32651", moved)


@pytest.mark.slow
def test_only_frames_near_the_prediction_are_accepted(
    dates: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    places, elsewhere = measure(*dates, 2, 2)
    assert [(a.verdict, a.sure, a.inside) for a in places] == [("accepted", True, True)] * 2
    assert max(a.error_px for a in places) < 2.0
    assert not any(a.sure for a in elsewhere)
    assert row("a on b", places, elsewhere).split()[3:6] == ["2", "100", "%"]
    other = map_rasters.utm(tmp_path / "o.tif", map_rasters.texture(800, 1200), crs="EPSG:32652")
    with pytest.raises(MapError, match="another coordinate system"):
        measure(dates[0], other, 1, 0)


def test_the_prediction_of_a_place_projects_map_pixels_correctly(dates: tuple[Path, Path]) -> None:
    """A map pixel projects into the camera above another pixel at the correct image position."""
    places = Places(*dates)
    px, other_px = np.array([500.0, 400.0]), np.array([600.0, 430.0])
    origin, prediction = places.prior(px)
    relative_m = [*(places.local_m(other_px) - places.local_m(px)), -prediction.agl_m]
    ray = rot_from_quat(prediction.q_w_c).T @ np.array(relative_m)
    assert ray[:2] / ray[2] * FOCAL_PX == pytest.approx([100.0, 30.0], abs=0.1)
    assert (origin.camera.fx, origin.camera.cx) == (FOCAL_PX, 199.5)


@pytest.mark.parametrize("elsewhere", [False, True])
def test_no_positions_are_drawn_where_the_map_is_empty(
    dates: tuple[Path, Path], tmp_path: Path, *, elsewhere: bool
) -> None:
    """The right half of the second image is empty: neither true nor predicted positions are drawn there."""
    ground = np.ascontiguousarray(texture(6, 300.0)[:880])
    half = ground.shape[1] // 2
    ground[:, half:] = 0
    second = map_rasters.utm(tmp_path / "half.tif", ground[:, :, ::-1].transpose(2, 0, 1))
    places = Places(dates[0], second)
    drawn = [places.draw(elsewhere)[2 if elsewhere else 1] for _ in range(5)]
    assert max(px[0] for px in drawn) < half - 180


def test_the_covariance_of_the_centre_point_equals_that_of_sampled_poses() -> None:
    rng = np.random.default_rng(1)
    half = rng.normal(size=(6, 6)) * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])[:, None]
    cov, p = half @ half.T, np.array([10.0, -20.0, 100.0])
    down = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])

    def centre_point(error: np.ndarray) -> np.ndarray:
        """The centre point for a pose error by the definition of the covariance: position, small rotation about the
        world axes."""
        axis, position_m = (exp_so3(error[3:]) @ down)[:, 2], p + error[:3]
        return (position_m - axis * position_m[2] / axis[2])[:2]

    cloud = np.array([centre_point(e) for e in rng.multivariate_normal(np.zeros(6), cov, 20_000)])
    match = MapMatch(
        t_ns=0, frame_id=0, verdict=Verdict.ACCEPTED, matcher="gradient", map_sigma_m=3.0,
        pose=MapPose(
            p_c_in_w_m=(10.0, -20.0, 100.0), q_w_c=quat_from_rot(down), cov=tuple(cov.ravel().tolist())
        ),
    )  # fmt: skip
    place_m, found = centre_point_of(match)
    assert place_m == pytest.approx([10.0, -20.0])
    assert found - 9.0 * np.eye(2) == pytest.approx(np.cov(cloud.T), rel=0.1, abs=0.1)
