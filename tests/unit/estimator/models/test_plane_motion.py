"""Metric motion between two cameras over a ground plane, from matched rays and the height."""

import numpy as np
import pytest

from terrafix.core.geodesy import yaw_of
from terrafix.core.pose import exp_so3, log_so3
from terrafix.estimator.measurements.telemetry_buffer import UNKNOWN_ATTITUDE_RAD
from terrafix.estimator.models.plane_motion import Ground, RelativePose, relative_pose
from terrafix.vision.feature_tracker import FrameTracker
from terrafix_lab.sim.true_messages import apply, homography
from textured_ground import PINHOLE, rotation, texture, view

AGL_M = 100.0
SIGMA = 1.0 / 380.0  # one pixel
TILT_SIGMA_RAD = np.radians(30.0)  # unknown tilt of the second camera
FLAT = Ground(AGL_M, 2.0)
Pose = tuple[np.ndarray, np.ndarray]


def pairs_between(a: Pose, b: Pose, count: int, rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Matched normalised coordinates (N, 4) of ground points that camera a sees, noise on the second."""
    seen = np.column_stack([rng.uniform(-0.8, 0.8, count), rng.uniform(-0.45, 0.45, count)])
    return np.hstack([seen, apply(homography(a, b), seen) + rng.normal(0.0, sigma, (count, 2))])


def between(a: Pose, b: Pose) -> tuple[np.ndarray, np.ndarray]:
    """True pose of camera b in camera a."""
    return a[0].T @ b[0], a[0].T @ (b[1] - a[1])


FIRST = (rotation(30.0), np.array([0.0, 0.0, AGL_M]))
SECOND = {
    "forward": (rotation(30.0), np.array([6.0, 10.0, AGL_M])),
    "turn": (rotation(55.0), np.array([3.0, 4.0, AGL_M])),
    "climb": (rotation(30.0), np.array([1.0, 2.0, AGL_M + 8.0])),
    "tilt": (rotation(33.0, 4.0, -6.0), np.array([5.0, 5.0, AGL_M - 2.0])),
    "still": FIRST,
    "about face": (rotation(-150.0), np.array([2.0, -1.0, AGL_M])),
}


@pytest.mark.parametrize("name", SECOND)
def test_rotation_and_metric_translation_match_the_truth(name: str) -> None:
    rng = np.random.default_rng(5)
    second = SECOND[name]
    r_true, p_true = between(FIRST, second)
    pairs = pairs_between(FIRST, second, 80, rng, 1e-5)
    motion = relative_pose(
        pairs, SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, FLAT
    )  # unknown attitude of the second camera
    assert motion is not None
    assert np.degrees(np.linalg.norm(log_so3(r_true.T @ motion.r))) < 0.02
    assert np.linalg.norm(motion.p_m - p_true) < 0.05


@pytest.mark.parametrize("name", ["forward", "turn", "climb", "tilt"])
def test_motion_from_rendered_pictures_is_within_its_covariance(name: str) -> None:
    ground, second = texture(2, 340.0), SECOND[name]
    tracker = FrameTracker(PINHOLE)
    tracker.track(0, view(ground, PINHOLE, *FIRST))
    seen = tracker.track(1, view(ground, PINHOLE, *second))
    motion = relative_pose(seen.two_view, seen.sigma_norm, FIRST[0], second[0], TILT_SIGMA_RAD, FLAT)
    assert motion is not None
    r_true, p_true = between(FIRST, second)
    assert np.degrees(np.linalg.norm(log_so3(r_true.T @ motion.r))) < 0.5
    assert np.linalg.norm(motion.p_m - p_true) < 1.0  # 1 % of the height
    error = np.concatenate([log_so3(r_true.T @ motion.r), motion.r.T @ (motion.p_m - p_true)])
    assert error @ np.linalg.solve(motion.cov, error) < 22.5  # chi-square, 6 degrees of freedom, 99.9 %


@pytest.mark.parametrize("guess_error_deg", [0.0, 2.0, 4.0])
def test_the_mirror_solution_of_the_plane_is_rejected(guess_error_deg: float) -> None:
    """Two views of a plane have a second solution in which tilt and translation are exchanged."""
    rng = np.random.default_rng(8)
    for _ in range(30):
        yaw, tilt = float(rng.uniform(-180, 180)), rng.uniform(-8.0, 8.0, 2)
        first = (rotation(yaw, *tilt), np.array([0.0, 0.0, AGL_M]))
        second = (rotation(yaw + rng.uniform(-15, 15), *(tilt + rng.normal(0.0, 2.0, 2))), rng.normal(0.0, 15.0, 3))
        second[1][2] = AGL_M + rng.normal(0.0, 2.0)
        r_true, p_true = between(first, second)
        guess = second[0] @ exp_so3(np.radians(guess_error_deg) * rng.choice([-1.0, 1.0], 3) / np.sqrt(3.0))
        pairs = pairs_between(first, second, 80, rng, 0.3 * SIGMA)
        motion = relative_pose(pairs, SIGMA, first[0], guess, TILT_SIGMA_RAD, FLAT)
        assert motion is not None
        assert np.degrees(np.linalg.norm(log_so3(r_true.T @ motion.r))) < 1.0
        assert np.linalg.norm(motion.p_m - p_true) < 2.0


def test_a_height_error_scales_the_translation_and_is_in_its_covariance() -> None:
    rng = np.random.default_rng(2)
    second = SECOND["forward"]
    _, p_true = between(FIRST, second)
    pairs = pairs_between(FIRST, second, 80, rng, 1e-5)
    low = relative_pose(pairs, 1e-5, FIRST[0], FIRST[0], TILT_SIGMA_RAD, Ground(0.9 * AGL_M, 0.1 * AGL_M))
    assert low is not None
    assert low.p_m == pytest.approx(0.9 * p_true, abs=0.02)
    error = low.r.T @ (low.p_m - p_true)
    along = error / np.linalg.norm(error)
    assert float(np.sqrt(along @ low.cov[3:, 3:] @ along)) == pytest.approx(np.linalg.norm(error), rel=0.3)


def test_the_covariance_is_consistent_with_the_errors() -> None:
    rng = np.random.default_rng(4)
    second = SECOND["tilt"]
    r_true, p_true = between(FIRST, second)
    nees = []
    for _ in range(200):
        pairs = pairs_between(FIRST, second, 10, rng, SIGMA)  # few enough to count as independent
        motion = relative_pose(pairs, SIGMA, FIRST[0], second[0], TILT_SIGMA_RAD, Ground(AGL_M, 0.0))
        assert motion is not None
        error = np.concatenate([log_so3(r_true.T @ motion.r), motion.r.T @ (motion.p_m - p_true)])
        nees.append(error @ np.linalg.solve(motion.cov, error))
    assert 2.0 < np.mean(nees) < 8.0  # expected 6; an overconfident covariance is the worse error


@pytest.mark.parametrize("slope", [(0.1, 0.0), (0.0, -0.15), (-0.08, 0.12)])
def test_a_slope_is_exact_with_a_dem_and_within_the_covariance_without(slope: tuple[float, float]) -> None:
    """The same motion over a hillside: exact with the slope of a DEM; without it the error is within the covariance."""
    rng = np.random.default_rng(9)
    r, p = SECOND["tilt"]
    seen = np.column_stack([rng.uniform(-0.7, 0.7, 80), rng.uniform(-0.4, 0.4, 80), np.ones(80)])
    rays = seen @ FIRST[0].T
    points = FIRST[1] + rays * (AGL_M / (rays[:, :2] @ np.array(slope) - rays[:, 2]))[:, None]
    in_k = (points - p) @ r
    pairs = np.hstack([seen[:, :2], in_k[:, :2] / in_k[:, 2:]])
    r_true, p_true = between(FIRST, (r, p))
    known = relative_pose(
        pairs, SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, Ground(AGL_M, 2.0, slope_e=slope[0], slope_n=slope[1])
    )
    assert known is not None
    assert np.linalg.norm(log_so3(r_true.T @ known.r)) < 1e-4 and np.linalg.norm(known.p_m - p_true) < 0.02
    unknown = relative_pose(pairs, SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, Ground(AGL_M, 2.0, slope_sigma=0.15))
    assert unknown is not None
    error = np.concatenate([log_so3(r_true.T @ unknown.r), unknown.r.T @ (unknown.p_m - p_true)])
    assert error @ np.linalg.solve(unknown.cov, error) < 22.5


def test_a_large_tilt_change_is_accepted_only_with_unknown_tilt_and_a_good_fit() -> None:
    rng = np.random.default_rng(6)
    leaning = (rotation(-10.0, 5.0, 22.0), np.array([3.0, 5.0, AGL_M]))
    r_true, p_true = between(FIRST, leaning)
    pairs = pairs_between(FIRST, leaning, 80, rng, 1e-4)
    unreported = relative_pose(pairs, SIGMA, FIRST[0], FIRST[0], UNKNOWN_ATTITUDE_RAD, FLAT)
    assert unreported is not None
    assert np.degrees(np.linalg.norm(log_so3(r_true.T @ unreported.r))) < 0.5
    assert np.linalg.norm(unreported.p_m - p_true) < 1.0
    assert relative_pose(pairs, SIGMA, FIRST[0], FIRST[0], np.radians(2.0), FLAT) is None
    wavy = pairs + rng.normal(0.0, 3.0 * SIGMA, pairs.shape)  # matches that do not fit a plane
    assert relative_pose(wavy, SIGMA, FIRST[0], FIRST[0], UNKNOWN_ATTITUDE_RAD, FLAT) is None


def test_degenerate_matches_give_no_motion() -> None:
    rng = np.random.default_rng(6)
    pairs = pairs_between(FIRST, SECOND["forward"], 80, rng, 1e-4)
    assert relative_pose(pairs[:5], SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, FLAT) is None
    assert relative_pose(np.zeros((0, 4)), SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, FLAT) is None
    assert relative_pose(np.repeat(pairs[:1], 30, axis=0), SIGMA, FIRST[0], FIRST[0], TILT_SIGMA_RAD, FLAT) is None
    sky = rotation(30.0, 130.0)  # the camera looks up: no ground in view
    assert relative_pose(pairs, SIGMA, sky, sky, TILT_SIGMA_RAD, FLAT) is None


def test_a_chain_of_two_thousand_rotations_stays_orthonormal() -> None:
    rng = np.random.default_rng(7)
    now: Pose = (rotation(10.0), np.array([0.0, 0.0, AGL_M]))
    r_chain = now[0]
    for _ in range(2000):
        turned = now[0] @ exp_so3(np.append(rng.normal(0.0, 1e-3, 2), rng.normal(0.0, 0.05)))
        level = rotation(np.degrees(yaw_of(turned @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]))))
        after: Pose = (level, np.array([4.0, 1.0, AGL_M]))
        pairs = pairs_between(now, after, 12, rng, 1e-4)
        motion: RelativePose | None = relative_pose(pairs, SIGMA, now[0], now[0], TILT_SIGMA_RAD, FLAT)
        assert motion is not None
        r_chain = r_chain @ motion.r
        now = (after[0], np.array([0.0, 0.0, AGL_M]))
    assert r_chain.T @ r_chain == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(r_chain) == pytest.approx(1.0, abs=1e-9)


def test_the_scale_sigma_of_a_translation_combines_height_and_level() -> None:
    assert Ground(100.0, 3.0, level_share=0.04).translation_scale_sigma == pytest.approx(0.05)
