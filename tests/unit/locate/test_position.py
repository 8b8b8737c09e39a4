"""Position of an object by rays and ground, its covariance, and the test of several pixels against each other."""

from dataclasses import replace

import numpy as np
import pytest

import pointed_flight as rig
from terrafix.core.errors import UsageError
from terrafix.core.pose import exp_so3
from terrafix_tools.locate.ground import GroundPatch, Surface
from terrafix_tools.locate.position import CHI2_999, Pixel, check_pixel, locate_object

SMALL = np.diag([1.0, 1.0, 1.0, 1e-4, 1e-4, 1e-4])
MAST_M = np.array([50.0, 10.0, 520.0])  # top of a mast above ground of 500 m


def at(i: int, point_m: np.ndarray, cov: np.ndarray | None = None) -> Pixel:
    return Pixel(rig.view(i, SMALL if cov is None else cov), *rig.pixel(i, point_m))


def level(sigma_m: float, surface: Surface = Surface.PLANE, up_m: float = 500.0) -> GroundPatch:
    return GroundPatch(surface, np.zeros(2), up_m, np.zeros(2), sigma_m)


def test_one_pixel_is_the_end_of_its_ray_on_sloping_ground() -> None:
    ground = GroundPatch(Surface.ELEVATION, np.array([10.0, 0.0]), 505.0, np.array([0.1, -0.2]), 1.0)
    point = np.array([40.0, -20.0, 505.0 + 3.0 + 4.0])
    found = locate_object([at(1, point)], [ground])
    assert found.p_m == pytest.approx(point, abs=1e-6)
    assert found.surface is Surface.ELEVATION
    assert found.test_ratios == pytest.approx([0.0], abs=1e-9)


def test_covariance_is_that_of_points_with_drawn_errors() -> None:
    random = np.random.default_rng(1)
    root = random.normal(size=(6, 6)) * np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])[:, None]
    ground = GroundPatch(Surface.PLANE, np.zeros(2), 500.0, np.array([0.1, 0.05]), 2.0)
    nominal = at(2, np.array([90.0, 40.0, 511.0]), root @ root.T)
    drawn = []
    for _ in range(4000):
        error = root @ random.normal(size=6)
        camera = nominal.view
        moved = replace(camera, p_c_in_w_m=camera.p_c_in_w_m + error[:3], r_w_c=exp_so3(error[3:]) @ camera.r_w_c)
        u, v = np.array([nominal.u, nominal.v]) + random.normal(size=2)
        shifted = replace(ground, up_m=500.0 + 2.0 * float(random.normal()))
        drawn.append(shifted.intersect(moved.p_c_in_w_m, Pixel(moved, u, v).ray()))
    stated, sampled = locate_object([nominal], [ground]).cov, np.cov(np.array(drawn).T)
    assert np.linalg.eigvals(np.linalg.solve(stated, sampled)).real == pytest.approx(np.ones(3), abs=0.12)


def test_radius_is_the_longer_half_axis_of_the_95_percent_ellipse() -> None:
    cov = np.diag([9.0, 4.0, 1e-8, 1e-12, 1e-12, 1e-12])
    found = locate_object([at(0, np.array([0.0, 0.0, 500.0]), cov)], [level(1e-3)])
    pixel_m = 100.0 / 500.0  # one pixel on the ground
    assert found.radius95_m == pytest.approx(np.sqrt(5.991 * (9.0 + pixel_m**2)), rel=1e-3)


@pytest.mark.parametrize("sigma_m", [30.0, 0.2])
def test_several_pixels_find_the_height_of_what_stands_above_the_ground(sigma_m: float) -> None:
    small = np.diag([0.01, 0.01, 0.01, 1e-8, 1e-8, 1e-8])
    pixels = [at(i, MAST_M, small) for i in (0, 2, 4)]
    found = locate_object(pixels, [level(sigma_m)] * 3)
    assert found.p_m == pytest.approx(MAST_M, abs=0.3)
    assert found.cov[2, 2] < 4.0
    alone = locate_object(pixels[:1], [level(30.0)])
    assert np.hypot(*(alone.p_m - MAST_M)[:2]) > 5.0 and alone.cov[2, 2] == pytest.approx(900.0, rel=1e-3)


def test_a_height_that_the_pixels_do_not_determine_is_that_of_the_ground() -> None:
    above = np.array([30.0, 10.0, 505.0])  # two cameras 20 m apart know the height to 14 m
    assert locate_object([at(0, above), at(1, above)], [level(0.2)] * 2).p_m[2] == pytest.approx(500.0, abs=0.1)


def test_level_of_camera_and_ground_is_in_the_height_and_not_in_the_position() -> None:
    point = np.array([60.0, 0.0, 500.0])
    one, other = (locate_object([at(0, point)], [replace(level(0.3), level_sigma_m=s)]).cov for s in (0.0, 2.0))
    assert other - one == pytest.approx(np.diag([0.0, 0.0, 4.0]))


def test_pixels_of_one_flight_do_not_average_their_errors_away() -> None:
    point = np.array([40.0, 0.0, 500.0])
    one = locate_object([at(2, point)], [level(1.0)])
    five = locate_object([at(2, point)] * 5, [level(1.0)] * 5)
    assert five.cov == pytest.approx(one.cov, rel=1e-6)


def test_most_exact_ground_of_the_first_kind_counts() -> None:
    point = np.array([40.0, 0.0, 503.0])
    patches = [
        level(0.5, Surface.PLANE, 490.0),
        level(3.0, Surface.POINTS, 480.0),
        level(2.0, Surface.POINTS, 503.0),
    ]
    found = locate_object([at(i, point) for i in (1, 2, 3)], patches)
    assert found.surface is Surface.POINTS
    assert found.p_m == pytest.approx(point, abs=1e-6)


def test_test_ratio_is_the_squared_mahalanobis_distance_over_its_gate() -> None:
    point, cov = np.array([0.0, 0.0, 500.0]), np.diag([4.0, 4.0, 1e-9, 1e-12, 1e-12, 1e-12])
    first = at(0, point + np.array([3.0, 0.0, 0.0]), cov)
    second = at(0, point - np.array([3.0, 0.0, 0.0]), cov)
    found = locate_object([first, second], [level(0.01)] * 2)
    assert found.p_m == pytest.approx(point, abs=1e-4)
    assert found.test_ratios == pytest.approx([9.0 / (4.0 + 0.2**2) / CHI2_999] * 2, rel=1e-3)


@pytest.mark.parametrize(("u", "v"), [(-0.6, 10.0), (10.0, -0.6), (799.6, 10.0), (10.0, 599.6)])
def test_pixel_outside_the_frame_is_refused(u: float, v: float) -> None:
    with pytest.raises(UsageError, match=r"outside the frame, which has 800 x 600 pixels"):
        check_pixel(Pixel(rig.view(0, SMALL), u, v))


@pytest.mark.parametrize(("u", "v"), [(-0.5, -0.5), (799.5, 599.5)])
def test_pixel_at_the_border_is_in_the_frame(u: float, v: float) -> None:
    check_pixel(Pixel(rig.view(0, SMALL), u, v))
