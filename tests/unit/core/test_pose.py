"""Pose from 2D-3D matches: exact where it can be, robust where it must be, honest about what is left."""

from collections.abc import Callable

import numpy as np
import pytest

from terrafix.core.geodesy import rot_w_b
from terrafix.core.pose import (
    exp_so3,
    fit_pose,
    log_so3,
    project_with_jacobian,
    tangent_to_world,
    world_to_tangent,
)

DOWN = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])  # R_w_c of a camera that looks straight down, image top north
FLOOR = 1e-4
AGL_M = 100.0


def looking(yaw: float = 0.4, tilt: tuple[float, float] = (0.08, -0.05)) -> np.ndarray:
    return exp_so3(np.array([0.0, 0.0, -yaw])) @ DOWN @ exp_so3(np.array([*tilt, 0.0]))


def scene(count: int, seed: int, relief_m: float = 6.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-60.0, 60.0, (count, 2)), rng.uniform(0.0, relief_m, count)])


def seen(points: np.ndarray, r: np.ndarray, p: np.ndarray) -> np.ndarray:
    in_c = (points - p) @ r
    return in_c[:, :2] / in_c[:, 2:]


@pytest.mark.parametrize("relief_m", [0.0, 6.0])
@pytest.mark.parametrize("seed", range(6))
def test_exact_from_a_bad_start(seed: int, relief_m: float) -> None:
    rng = np.random.default_rng(seed)
    r, p = looking(), np.array([5.0, -3.0, AGL_M])
    points = scene(40, seed, relief_m)
    start_r = r @ exp_so3(rng.uniform(-0.12, 0.12, 3))
    fit = fit_pose(points, seen(points, r, p), start_r, p + rng.uniform(-15.0, 15.0, 3), FLOOR)
    assert fit is not None
    assert np.abs(fit.p_c_in_w_m - p).max() < 1e-4
    assert np.abs(log_so3(r.T @ fit.r_w_c)).max() < 1e-6
    assert fit.r_w_c.T @ fit.r_w_c == pytest.approx(np.eye(3), abs=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_a_fifth_of_the_matches_may_be_wrong(seed: int) -> None:
    rng = np.random.default_rng([seed, 1])
    r, p = looking(), np.array([5.0, -3.0, AGL_M])
    points = scene(50, seed)
    xy = seen(points, r, p) + rng.normal(0.0, 1e-3, (50, 2))
    xy[:10] += rng.uniform(0.05, 0.2, (10, 2)) * rng.choice([-1.0, 1.0], (10, 2))
    fit = fit_pose(points, xy, r @ exp_so3(rng.uniform(-0.03, 0.03, 3)), p + rng.uniform(-5.0, 5.0, 3), 1e-3)
    assert fit is not None
    clean = fit_pose(points[10:], xy[10:], r, p, 1e-3)
    assert clean is not None
    assert np.linalg.norm(fit.p_c_in_w_m - p) < 2.0  # 2 % of the height
    assert fit.residuals[:10].min() > 10 * np.median(fit.residuals[10:])


def test_covariance_is_what_noise_does() -> None:
    rng = np.random.default_rng(7)
    r, p = looking(), np.array([5.0, -3.0, AGL_M])
    points, sigma = scene(60, 3), 2e-3
    truth = seen(points, r, p)
    errors, claimed = [], []
    for _ in range(500):
        fit = fit_pose(points, truth + rng.normal(0.0, sigma, truth.shape), r, p, 1e-9)
        assert fit is not None
        errors.append(np.concatenate([log_so3(r.T @ fit.r_w_c), r.T @ (fit.p_c_in_w_m - p)]))
        claimed.append(fit.cov)
    spread = np.std(errors, axis=0)
    assert np.sqrt(np.mean(claimed, axis=0).diagonal()) / spread == pytest.approx(np.ones(6), abs=0.2)
    nees = [e @ np.linalg.solve(c, e) for e, c in zip(errors, claimed, strict=True)]
    assert 5.0 < np.mean(nees) < 7.5  # chi-square with 6 degrees of freedom


def test_sigma_is_that_of_one_coordinate() -> None:
    rng = np.random.default_rng(8)
    r, p, points = looking(), np.array([0.0, 0.0, AGL_M]), scene(400, 5)
    fit = fit_pose(points, seen(points, r, p) + rng.normal(0.0, 3e-3, (400, 2)), r, p, 1e-6)
    assert fit is not None and fit.sigma == pytest.approx(3e-3, rel=0.15)
    floored = fit_pose(points, seen(points, r, p), r, p, 5e-3)
    assert floored is not None and floored.sigma == 5e-3


def test_fewer_independent_matches_claim_less() -> None:
    r, p, points = looking(), np.array([0.0, 0.0, AGL_M]), scene(40, 5)
    xy = seen(points, r, p)
    all_of_them, a_quarter = (fit_pose(points, xy, r, p, 1e-3, independent_share=e) for e in (1.0, 0.25))
    assert all_of_them is not None and a_quarter is not None
    assert a_quarter.cov == pytest.approx(4.0 * all_of_them.cov)


def test_a_weight_of_zero_is_no_match() -> None:
    r, p, points = looking(), np.array([0.0, 0.0, AGL_M]), scene(40, 5)
    xy = seen(points, r, p)
    xy[:3] += 0.5
    fit = fit_pose(points, xy, r, p, 1e-3, np.r_[np.zeros(3), np.ones(37)])
    assert fit is not None and np.abs(fit.p_c_in_w_m - p).max() < 1e-4


@pytest.mark.parametrize(
    "spoil",
    [
        lambda points: points[:2],  # four numbers do not make six
        lambda points: np.repeat(points[:1], 30, axis=0),  # one point, many times
        lambda points: np.linspace(points[0], points[1], 30),  # all on a line
    ],
)
def test_geometry_that_determines_no_pose_is_none(spoil: Callable[[np.ndarray], np.ndarray]) -> None:
    r, p = looking(), np.array([0.0, 0.0, AGL_M])
    points = spoil(scene(30, 1))
    assert fit_pose(points, seen(points, r, p), r, p, 1e-3) is None


def test_points_behind_the_camera_are_none() -> None:
    r, p, points = looking(), np.array([0.0, 0.0, AGL_M]), scene(30, 1)
    assert fit_pose(points, seen(points, r, p), r, np.array([0.0, 0.0, -AGL_M]), 1e-3) is None


def test_the_jacobian_is_the_derivative() -> None:
    r, p, points = looking(), np.array([5.0, -3.0, AGL_M]), scene(12, 2)
    _, jacobian, depth = project_with_jacobian(r, p, points)
    assert depth == pytest.approx(((points - p) @ r)[:, 2])
    step = 1e-6
    for k in range(6):
        d = np.zeros(6)
        d[k] = step
        ahead, _, _ = project_with_jacobian(r @ exp_so3(d[:3]), p + r @ d[3:], points)
        behind, _, _ = project_with_jacobian(r @ exp_so3(-d[:3]), p - r @ d[3:], points)
        assert jacobian[:, :, k] == pytest.approx((ahead - behind) / (2 * step), abs=1e-6)


def test_tangent_and_world_and_back() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(6, 6))
    cov, r = a @ a.T, looking()
    world = tangent_to_world(cov, r)
    assert world_to_tangent(world, r) == pytest.approx(cov)
    assert world[:3, :3] == pytest.approx(r @ cov[3:, 3:] @ r.T)  # position first, towards east, north, up
    assert world[3:, 3:] == pytest.approx(r @ cov[:3, :3] @ r.T)


def test_a_sigma_towards_north_stays_there() -> None:
    r = rot_w_b(1.1, 0.0, 0.0) @ DOWN  # turned: the camera's axes are not the world's
    cov = world_to_tangent(np.diag([1.0, 25.0, 4.0, 1e-4, 1e-4, 1e-2]), r)
    assert tangent_to_world(cov, r).diagonal() == pytest.approx([1.0, 25.0, 4.0, 1e-4, 1e-4, 1e-2])
    assert cov[2, 2] == pytest.approx(1e-2)  # the optical axis is the vertical: heading is rotation about it


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 1e-5, 0.3, 1.5, 3.0])
def test_exp_and_log_are_inverse(angle: float) -> None:
    for axis in np.random.default_rng(2).normal(size=(20, 3)):
        w = angle * axis / np.linalg.norm(axis)
        assert log_so3(exp_so3(w)) == pytest.approx(w, abs=1e-8)
