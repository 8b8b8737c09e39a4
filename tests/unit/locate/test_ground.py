"""Ground at the end of a ray: point cloud, elevation, plane."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pointed_flight as rig
from flight_records import write_record
from terrafix import messages as m
from terrafix.core.errors import SourceError
from terrafix_tools.console.compute.locating import Locators
from terrafix_tools.console.locating import Question
from terrafix_tools.finalise.point_cloud import POINTS, VERTEX, write_ply
from terrafix_tools.finalised import write
from terrafix_tools.locate.cloud import PointCloud, build_cloud
from terrafix_tools.locate.ground import GroundPatch, Surface, ground_patch
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.locate.views import CameraView, read_views

EMPTY = PointCloud(np.zeros((0, 3)), np.zeros(0))
DOWN = np.array([0.0, 0.0, -1.0])
OBLIQUE = np.array([0.6, 0.0, -0.8])


def view() -> CameraView:
    """100 m above ground of 500 m, at east 0, north 0."""
    return rig.view(0, np.eye(6))


def hit(patch: GroundPatch, ray: np.ndarray) -> np.ndarray:
    return patch.intersect(view().p_c_in_w_m, ray)


def around(at_e_m: float, up_m: float, *, count: int = 12, sigma_m: float = 0.2) -> PointCloud:
    """Points on a circle of 5 m about (at_e_m, 0)."""
    angle = np.arange(count) * 2.0 * np.pi / count
    points = np.column_stack([at_e_m + 5.0 * np.cos(angle), 5.0 * np.sin(angle), np.full(count, up_m)])
    return PointCloud(points, np.full(count, sigma_m))


def test_without_map_and_points_the_ground_is_level_below_the_camera() -> None:
    patch = ground_patch(view(), OBLIQUE, EMPTY, None)
    assert patch.surface is Surface.PLANE
    assert hit(patch, OBLIQUE) == pytest.approx([75.0, 0.0, 500.0])
    # 1.2 m, 2 % of the height, slope of 3 % over 75 m
    assert patch.sigma_m == pytest.approx(np.linalg.norm([1.2, 2.0, 2.25]))


def test_plane_of_the_map_match_gives_slope_and_relief() -> None:
    ground = m.GroundPlane(amsl_m=500.0, slope_e=0.2, slope_n=0.0, relief_m=4.0)
    patch = ground_patch(replace(view(), ground=ground), OBLIQUE, EMPTY, None)
    e_m = 75.0 / 1.15  # 0.75 (100 - 0.2 e) = e
    assert hit(patch, OBLIQUE) == pytest.approx([e_m, 0.0, 500.0 + 0.2 * e_m])
    assert patch.sigma_m == pytest.approx(np.linalg.norm([1.2, 1.0, 0.015 * e_m, 4.0]))


def test_ray_ends_at_the_first_crossing_of_the_elevation() -> None:
    def ridge(e_m: np.ndarray, _n_m: np.ndarray) -> np.ndarray:
        return 500.0 + np.where(np.abs(e_m - 50.0) < 8.0, 60.0, 0.0)

    patch = ground_patch(view(), OBLIQUE, EMPTY, ridge)
    assert patch.surface is Surface.ELEVATION
    assert hit(patch, OBLIQUE)[0] == pytest.approx(42.0, abs=1.0)


def test_slope_of_the_elevation_is_that_of_the_patch() -> None:
    patch = ground_patch(view(), OBLIQUE, EMPTY, lambda e_m, n_m: 500.0 + 0.2 * e_m - 0.1 * n_m)
    assert patch.slope == pytest.approx([0.2, -0.1])
    assert hit(patch, OBLIQUE) == pytest.approx([75.0 / 1.15, 0.0, 500.0 + 15.0 / 1.15], abs=0.01)
    assert patch.sigma_m == pytest.approx(np.hypot(1.2, 1.0))


def test_edge_that_falls_steeper_than_the_ray_counts_as_level() -> None:
    patch = ground_patch(view(), OBLIQUE, EMPTY, lambda e_m, _n_m: 500.0 - 60.0 * (e_m > 80.0))
    assert patch.slope == pytest.approx([0.0, 0.0])
    assert hit(patch, OBLIQUE) == pytest.approx([75.0, 0.0, 500.0], abs=0.01)


def test_slope_under_points_is_that_of_the_elevation() -> None:
    cloud = around(0.0, 512.0)
    rising = PointCloud(cloud.points_m + cloud.points_m[:, :1] * [0.0, 0.0, 0.2], cloud.sigma_m)
    patch = ground_patch(view(), DOWN, rising, lambda e_m, n_m: 500.0 + 0.2 * e_m)
    assert patch.surface is Surface.POINTS and patch.slope == pytest.approx([0.2, 0.0])
    assert hit(patch, DOWN)[2] == pytest.approx(512.0)
    assert patch.sigma_m == pytest.approx(0.2 / np.sqrt(12))  # the points agree: the error of their mean
    assert patch.level_sigma_m == pytest.approx(np.hypot(1.2, 1.0))  # the level is that of the elevation


def test_where_the_elevation_is_unknown_the_plane_is_used() -> None:
    patch = ground_patch(view(), OBLIQUE, EMPTY, lambda e_m, _n_m: np.where(e_m < 40.0, 500.0, np.nan))
    assert patch.surface is Surface.PLANE


def test_ray_is_followed_to_the_points_where_they_stand_above_the_elevation() -> None:
    patch = ground_patch(view(), OBLIQUE, around(66.0, 512.0, count=20), None)
    assert patch.surface is Surface.POINTS
    assert hit(patch, OBLIQUE) == pytest.approx([66.0, 0.0, 512.0])


def test_points_that_do_not_lie_in_a_plane_widen_the_height() -> None:
    cloud = around(0.0, 500.0)
    rough = PointCloud(cloud.points_m + np.array([0.0, 0.0, 1.0]) * np.tile([3.0, -3.0], 6)[:, None], cloud.sigma_m)
    patch = ground_patch(view(), DOWN, rough, None)
    departure_m2 = 9.0 * 12 / 11  # of 12 points about their mean
    assert patch.sigma_m == pytest.approx(np.sqrt((departure_m2 - 0.2**2) * (1.0 + 1.0 / 12) + 0.2**2 / 12))


def test_errors_of_the_points_are_not_relief() -> None:
    cloud = around(0.0, 500.0, sigma_m=3.0)
    noise_m = np.random.default_rng(2).normal(0.0, 3.0, 12)
    patch = ground_patch(
        view(), DOWN, PointCloud(cloud.points_m + noise_m[:, None] * [0.0, 0.0, 1.0], cloud.sigma_m), None
    )
    assert 0.5 * 3.0 / np.sqrt(12) < patch.sigma_m < 2.0 * 3.0 / np.sqrt(12)


def test_points_behind_the_camera_are_not_below_it() -> None:
    below = around(0.0, 503.0)
    mirrored = replace(below, points_m=2.0 * view().p_c_in_w_m - below.points_m)
    assert ground_patch(view(), DOWN, mirrored, None).surface is Surface.PLANE


def test_points_with_large_errors_count_less() -> None:
    cloud = around(0.0, 500.0)
    points, sigma_m = cloud.points_m.copy(), cloud.sigma_m.copy()
    points[::2, 2], sigma_m[::2] = 510.0, 20.0
    assert hit(ground_patch(view(), DOWN, PointCloud(points, sigma_m), None), DOWN)[2] == pytest.approx(500.0, abs=0.05)


@pytest.mark.parametrize("cloud", [around(0.0, 512.0, count=5), around(40.0, 512.0)])
def test_few_points_or_points_far_away_are_not_used(cloud: PointCloud) -> None:
    assert ground_patch(view(), DOWN, cloud, None).surface is Surface.PLANE


def test_beside_the_points_the_ground_may_be_theirs_or_that_without_them() -> None:
    """Points on a roof 12 m high, all on one side of the pixel."""
    above, aside = (ground_patch(view(), DOWN, around(e_m, 512.0), None) for e_m in (0.0, 9.0))
    assert above.surface is aside.surface is Surface.POINTS
    assert above.sigma_m < 3.0 and 12.0 < aside.sigma_m < 13.0


def test_points_aside_of_the_pixel_tell_less_by_the_error_of_the_slope() -> None:
    aside = ground_patch(view(), DOWN, around(18.0, 500.0), None)
    assert aside.sigma_m == pytest.approx(np.hypot(0.03 * 18.0, 0.2 / np.sqrt(12)), rel=1e-3)


@pytest.mark.parametrize("up", [0.5, 0.0, -0.04])
def test_pixel_of_horizon_or_sky_is_refused(up: float) -> None:
    with pytest.raises(SourceError, match="frame 0: the pixel shows no ground"):
        ground_patch(view(), np.array([np.sqrt(1.0 - up**2), 0.0, up]), EMPTY, None)


def test_cloud_of_a_flight_has_ground_and_house(tmp_path: Path) -> None:
    flight = read_views(rig.write_flight(tmp_path / "flight.mcap"))
    cloud = build_cloud(flight, 0, None)
    true_m = rig.ground_m(cloud.points_m[:, 0], cloud.points_m[:, 1])
    on_house = true_m > rig.START_AMSL_M
    assert len(cloud.points_m) > 2000 and on_house.sum() > 50
    assert np.abs(cloud.points_m[:, 2] - true_m).max() < 0.05
    assert cloud.sigma_m.min() > 0.0 and cloud.sigma_m.max() < 2.0
    assert len(build_cloud(flight, 1, None).points_m) == 0, "of another fragment"


def test_cloud_has_the_level_and_the_size_of_the_elevation(tmp_path: Path) -> None:
    flight = read_views(rig.write_flight(tmp_path / "flight.mcap"))
    cloud = build_cloud(flight, 0, lambda e_m, _n_m: np.full(e_m.shape, 520.0))
    away = np.abs(cloud.points_m[:, 0] - rig.HOUSE_E_M) > 25.0
    assert np.median(cloud.points_m[away, 2]) == pytest.approx(520.0, abs=0.05)
    assert np.median(cloud.sigma_m / build_cloud(flight, 0, None).sigma_m) == pytest.approx(0.8, abs=0.01)


def test_the_points_of_a_finalised_flight_are_used_whatever_their_fragment(tmp_path: Path) -> None:
    grid = np.arange(-100.0, 180.0, 4.0)
    e_m, n_m = (axis.ravel() for axis in np.meshgrid(grid, grid))
    points = np.zeros(len(e_m), VERTEX)
    points["x"], points["y"], points["z"], points["sigma"] = e_m, n_m, rig.ground_m(e_m, n_m), 0.1
    points["fragment"] = 7
    write_ply(tmp_path / POINTS, points, rig.ORIGIN)
    write_record(tmp_path / "flight.mcap", [x for x in rig.messages() if not getattr(x, "three_view", None)])
    roof = rig.pixel(3, np.array([rig.HOUSE_E_M, 0.0, rig.START_AMSL_M + rig.HOUSE_M]))
    locators, question = Locators(), Question(str(tmp_path), "", [(3, roof)])
    assert locators.answer(question).surface == "plane"
    write(tmp_path, [], {"flights": [{"solution": "refined"}]})
    found = locators.answer(question)
    assert found.surface == "points" and found.alt_amsl_m == pytest.approx(512.0, abs=0.2)
    (tmp_path / POINTS).write_bytes(b"ply")
    with pytest.raises(SourceError, match=r"points\.ply: cannot be read"):
        FlightLocator.open(tmp_path)
