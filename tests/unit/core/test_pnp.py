"""Pose from patch matches: right despite many wrong matches, none from random ones."""

from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from terrafix.core.geodesy import quat_from_rot
from terrafix.core.pnp import INLIER_THRESHOLD, PNP_MIN_INLIERS, PnpResult, solve
from terrafix.core.pose import exp_so3, log_so3
from terrafix.messages import PnpInput, Verdict
from textured_ground import rotation

AGL_M = 100.0
REACH = 0.08
SIGMA = 0.003
R, P = rotation(35.0, 3.0, -5.0), np.array([40.0, -15.0, 250.0 + AGL_M])


def scene(rng: np.random.Generator, count: int, relief_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) on the ground and their normalised image coordinates (N, 2)."""
    points = np.column_stack([P[:2] + rng.uniform(-55.0, 55.0, (count, 2)), 250.0 + rng.uniform(0, relief_m, count)])
    in_c = (points - P) @ R
    return points, in_c[:, :2] / in_c[:, 2:] + rng.normal(0.0, SIGMA, (count, 2))


GIVEN = PnpInput(
    q_w_c=quat_from_rot(R),
    agl_m=AGL_M,
    sigma_floor=SIGMA,
    threshold=INLIER_THRESHOLD,
    search_radius=REACH,
    min_inliers=PNP_MIN_INLIERS,
)


def solve_equal_weights(points: np.ndarray, xy: np.ndarray, r: np.ndarray = R, **given: Any) -> PnpResult:
    """``given``: other fields of GIVEN."""
    return solve(points, xy, np.ones(len(xy)), msgspec.structs.replace(GIVEN, q_w_c=quat_from_rot(r), **given))


@pytest.mark.parametrize("relief_m", [0.0, 8.0])
@pytest.mark.parametrize("seed", range(5))
def test_the_pose_is_right_with_forty_per_cent_wrong_matches(seed: int, relief_m: float) -> None:
    rng = np.random.default_rng([seed, 3])
    points, xy = scene(rng, 45, relief_m)
    wrong = np.arange(45) < 18
    points[wrong, :2] += rng.uniform(-REACH, REACH, (18, 2)) * AGL_M + rng.choice([-5.0, 5.0], (18, 2))
    predicted = R @ exp_so3(rng.normal(0.0, 0.03, 3))
    found = solve_equal_weights(points, xy, predicted)
    assert found.verdict is Verdict.ACCEPTED and found.fit is not None
    assert np.linalg.norm(found.fit.p_c_in_w_m - P) < 2.0
    assert np.degrees(np.linalg.norm(log_so3(R.T @ found.fit.r_w_c))) < 1.2
    assert found.inliers[~wrong].mean() > 0.9
    assert found.inliers[wrong].mean() < 0.35
    error = np.concatenate([log_so3(R.T @ found.fit.r_w_c), R.T @ (found.fit.p_c_in_w_m - P)])
    assert error @ np.linalg.solve(found.fit.cov, error) < 22.5  # chi-square, 6 degrees of freedom, 99.9 %


def test_large_coordinates_do_not_reduce_precision() -> None:
    rng = np.random.default_rng(2)
    points, xy = scene(rng, 40, 0.0)
    away = np.array([20_000.0, -15_000.0, 0.0])
    near, far = solve_equal_weights(points, xy), solve_equal_weights(points + away, xy)
    assert near.fit is not None and far.fit is not None
    assert far.fit.p_c_in_w_m - away == pytest.approx(near.fit.p_c_in_w_m, abs=0.01)


def exact_scene(relief_m: float) -> tuple[np.ndarray, np.ndarray]:
    """As ``scene``, with heights over exactly ``relief_m`` and image coordinates without noise."""
    points, _ = scene(np.random.default_rng(6), 40, 0.0)
    points[:, 2] += np.random.default_rng(7).permutation(np.linspace(0.0, relief_m, 40))
    in_c = (points - P) @ R
    return points, in_c[:, :2] / in_c[:, 2:]


@pytest.mark.parametrize(
    ("relief_share", "method"),
    [
        (0.0, cv2.SOLVEPNP_IPPE),
        (0.019, cv2.SOLVEPNP_IPPE),
        (0.021, cv2.SOLVEPNP_SQPNP),
        (0.3, cv2.SOLVEPNP_SQPNP),
    ],
)
def test_ground_with_less_relief_than_two_per_cent_of_the_height_is_solved_by_ippe_as_a_plane_and_more_by_sqpnp(
    relief_share: float, method: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: list[tuple[int, np.ndarray]] = []
    ransac = cv2.solvePnPRansac

    def recorded(object_points: np.ndarray, *args: object, flags: int, **options: object) -> object:
        used.append((flags, object_points.copy()))
        return ransac(object_points, *args, flags=flags, **options)  # type: ignore[call-overload]

    monkeypatch.setattr(cv2, "solvePnPRansac", recorded)
    points, xy = exact_scene(relief_share * AGL_M)
    assert solve_equal_weights(points, xy).verdict is Verdict.ACCEPTED
    [(flags, solved)] = used
    assert flags == method
    local = points - points.mean(0)
    assert solved[:, :2] == pytest.approx(local[:, :2])
    assert solved[:, 2] == pytest.approx(local[:, 2] if method == cv2.SOLVEPNP_SQPNP else np.zeros(len(points)))


@pytest.mark.parametrize("relief_share", [0.019, 0.021])
def test_the_refined_pose_uses_the_heights_of_near_planar_ground(relief_share: float) -> None:
    """As a plane, these exact matches would have residuals, and a pose that is off by decimetres."""
    points, xy = exact_scene(relief_share * AGL_M)
    given = points.copy()
    found = solve_equal_weights(points, xy)
    assert np.array_equal(points, given)
    assert found.fit is not None and found.inliers.all()
    assert np.linalg.norm(found.fit.p_c_in_w_m - P) < 1e-3
    assert found.fit.residuals.max() < 1e-5
    points[:, 2] = points[:, 2].mean()
    plane = solve_equal_weights(points, xy)
    assert plane.fit is not None and plane.fit.residuals.max() > 1e-3
    assert np.linalg.norm(plane.fit.p_c_in_w_m - P) > 0.05


@pytest.mark.parametrize("count", [0, 3, PNP_MIN_INLIERS - 1])
def test_few_matches_give_no_pose(count: int) -> None:
    points, xy = scene(np.random.default_rng(1), count, 5.0)
    found = solve_equal_weights(points, xy)
    assert (found.verdict, found.fit) == (Verdict.FEW_INLIERS, None)


def test_the_required_number_of_inliers_is_an_argument() -> None:
    points, xy = scene(np.random.default_rng(1), 18, 5.0)
    assert solve_equal_weights(points, xy).verdict is Verdict.ACCEPTED
    assert solve_equal_weights(points, xy, min_inliers=20).verdict is Verdict.FEW_INLIERS


def test_a_quarter_of_right_matches_gives_no_wrong_pose() -> None:
    rng = np.random.default_rng(1)
    points, xy = scene(rng, 48, 0.0)
    points[12:, :2] += rng.uniform(-2 * REACH, 2 * REACH, (36, 2)) * AGL_M
    found = solve_equal_weights(points, xy)
    assert found.fit is None or found.inliers[:12].all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("relief_m", "reach", "given"),
    [(0.0, REACH, {}), (6.0, REACH, {}), (0.0, 0.2, {"threshold": 0.05, "search_radius": 0.2})],
    ids=["flat ground", "relief", "the wide search"],
)
def test_random_matches_are_rejected(relief_m: float, reach: float, given: dict[str, float]) -> None:
    """Matches at a wrong place are random within the search radius. At most one of a hundred sets may be accepted."""
    passed = 0
    for seed in range(100):
        rng = np.random.default_rng([seed, 9 if reach == REACH else 10])
        points, xy = scene(rng, int(rng.integers(10, 49)), relief_m)
        points[:, :2] += rng.uniform(-reach, reach, (len(points), 2)) * AGL_M
        passed += solve_equal_weights(points, xy, **given).verdict is Verdict.ACCEPTED
    assert passed <= 1


def test_a_pose_far_from_the_predicted_tilt_is_rejected() -> None:
    points, xy = scene(np.random.default_rng(4), 40, 0.0)
    found = solve_equal_weights(points, xy, R @ exp_so3(np.array([0.5, 0.0, 0.0])))
    assert (found.verdict, found.fit) == (Verdict.DEGENERATE, None)
    turned = solve_equal_weights(
        points, xy, R @ exp_so3(np.array([0.0, 0.0, 1.0]))
    )  # the heading may differ from the prediction
    assert turned.verdict is Verdict.ACCEPTED


def test_the_pose_is_deterministic() -> None:
    rng = np.random.default_rng(5)
    points, xy = scene(rng, 40, 0.0)
    points[:15, :2] += rng.uniform(-6.0, 6.0, (15, 2))
    once, again = solve_equal_weights(points, xy), solve_equal_weights(points, xy)
    assert once.fit is not None and again.fit is not None
    assert np.array_equal(once.fit.p_c_in_w_m, again.fit.p_c_in_w_m)
    assert np.array_equal(once.inliers, again.inliers)


def test_the_pose_does_not_depend_on_which_sample_ransac_draws() -> None:
    """Another order of the matches is another sample. On the inliers of the first result alone it moved by 0.8 m."""
    rng = np.random.default_rng(5)
    points, xy = scene(rng, 40, 0.0)
    xy += rng.normal(0.0, 0.008, xy.shape)  # as patches of a map that is years old
    points[:15, :2] += rng.uniform(-6.0, 6.0, (15, 2))
    found = []
    for seed in range(6):
        order = np.random.default_rng(seed).permutation(40)
        fit = solve_equal_weights(points[order], xy[order]).fit
        assert fit is not None
        found.append(fit.p_c_in_w_m)
    assert np.ptp(found, axis=0).max() < 0.02


def test_a_match_whose_weight_vanishes_changes_nothing() -> None:
    points, xy = scene(np.random.default_rng(5), 30, 0.0)
    with_it, without = (
        solve(points[:n], xy[:n], np.r_[np.ones(29), np.full(n - 29, 1e-9)], GIVEN).fit for n in (30, 29)
    )
    assert with_it is not None and without is not None
    assert with_it.p_c_in_w_m == pytest.approx(without.p_c_in_w_m, abs=1e-3)
    assert with_it.cov == pytest.approx(without.cov, rel=0.01, abs=1e-7)


def mean_nees(wrong: int) -> float:
    """Mean NEES of poses from 48 patches with an error of 0.8 % of the height, of which ``wrong`` are at random
    places."""
    errors = []
    for seed in range(120):
        rng = np.random.default_rng([seed, 7])
        points = np.column_stack([P[:2] + rng.uniform(-40.0, 40.0, (48, 2)), np.full(48, 250.0)])
        in_c = (points - P) @ R
        xy = in_c[:, :2] / in_c[:, 2:] + rng.normal(0.0, 0.008, (48, 2))
        points[:wrong, :2] += rng.uniform(-REACH, REACH, (wrong, 2)) * AGL_M
        fit = solve_equal_weights(points, xy).fit
        assert fit is not None
        error = np.concatenate([log_so3(R.T @ fit.r_w_c), R.T @ (fit.p_c_in_w_m - P)])
        errors.append(float(error @ np.linalg.solve(fit.cov, error)))
    return float(np.mean(errors))


@pytest.mark.slow
def test_false_inliers_inflate_the_covariance() -> None:
    """Counted as inliers, the wrong matches raise the mean NEES by half."""
    assert mean_nees(wrong=26) < 1.3 * mean_nees(wrong=0)


def test_numbers_that_are_not_finite_are_degenerate() -> None:
    points, xy = scene(np.random.default_rng(1), 20, 0.0)
    for spoilt in (0, 1):
        arrays = [points.copy(), xy.copy()]
        arrays[spoilt][3, 1] = np.nan
        found = solve_equal_weights(*arrays)
        assert (found.verdict, found.fit) == (Verdict.DEGENERATE, None)
    weights = np.ones(20)
    weights[3] = np.inf
    assert solve(points, xy, weights, GIVEN).verdict is Verdict.DEGENERATE


def test_weights_count_in_the_refinement() -> None:
    points, xy = scene(np.random.default_rng(1), 20, 0.0)
    xy[:10] += 0.005
    heavy, light = (solve(points, xy, np.r_[np.full(10, weight), np.ones(10)], GIVEN).fit for weight in (1.0, 0.01))
    assert heavy is not None and light is not None
    assert light.residuals[10:].mean() < 0.7 * heavy.residuals[10:].mean()
