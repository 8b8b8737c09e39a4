"""Consensus pose: found over ground that has changed and leans, rejected at wrong places."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.verification.consensus_pose import ConsensusPose
from terrafix.core.pose import log_so3
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber
from textured_ground import GSD_M, PINHOLE, FlatMap, SlopedMap, rotation, texture, view

AGL_M = 100.0
SIDE_M = 400.0
R = rotation(40.0)
TILT_SIGMA_RAD = float(np.radians(1.0))


@pytest.fixture(scope="module")
def estimator() -> ConsensusPose:
    source = FlatMap(texture(8, SIDE_M))
    return ConsensusPose(FrameMatcher(PINHOLE, source, GradientDescriber()))  # type: ignore[arg-type]


def changed_ground(seed: int) -> np.ndarray:
    """Ground of another year: half of it is other ground, and its objects lean, blocks of 15 m together, by 3 m on each
    axis."""
    ground, rng = (
        cv2.addWeighted(texture(8, SIDE_M), 0.5, texture(20 + seed, SIDE_M), 0.5, 0.0),
        np.random.default_rng(seed),
    )
    side, blocks = len(ground), round(SIDE_M / 15.0)
    aside = [rng.normal(0.0, 3.0 / GSD_M, (blocks, blocks)).astype(np.float32) for _ in range(2)]
    dx, dy = (cv2.resize(a, (side, side), interpolation=cv2.INTER_LINEAR) for a in aside)
    x, y = np.meshgrid(np.arange(side, dtype=np.float32), np.arange(side, dtype=np.float32))
    return cv2.remap(ground, x + dx, y + dy, cv2.INTER_LINEAR)


def observation(ground: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray, View]:
    """An image, the camera position (3,), and the believed view."""
    rng = np.random.default_rng(100 + seed)
    here_m = np.array([*rng.uniform(-40.0, 40.0, 2), AGL_M])
    e_m, n_m = (float(v) for v in here_m[:2] + rng.normal(0.0, 3.0, 2))
    believed_view = View(e_m, n_m, R, 1.02 * AGL_M, 0.0, float(np.radians(3.0)), 0.03, TILT_SIGMA_RAD)
    return view(ground, PINHOLE, R, here_m), here_m, believed_view


@pytest.mark.slow
def test_over_changed_and_leaning_ground_the_pose_is_found_with_a_consistent_covariance(
    estimator: ConsensusPose,
) -> None:
    """The mean NEES of three numbers over eight places is below 5.0 with a probability of 99 % if the covariance is
    exact."""
    nees = []
    for seed in range(8):
        image, here_m, believed_view = observation(changed_ground(seed), seed)
        fix = estimator.estimate(image, believed_view)
        assert fix is not None and fix.pnp.verdict is Verdict.ACCEPTED and fix.pnp.fit is not None
        fit = fix.pnp.fit
        off_m = fit.r_w_c.T @ (fit.p_c_in_w_m - here_m)
        nees.append(off_m @ np.linalg.solve(fit.cov[3:, 3:], off_m))
        middle_m = (fit.p_c_in_w_m - fit.r_w_c[:, 2] * fit.p_c_in_w_m[2] / fit.r_w_c[2, 2])[:2]
        assert np.hypot(*(middle_m - here_m[:2])) < 2.5
    assert np.mean(nees) < 5.0


def test_the_consensus_pose_is_from_map_points_with_the_heights_of_the_dem() -> None:
    """In a turn: of a frame that is projected on a plane the pose is 10 m off."""
    ground, slope, amsl_m, r = texture(8, SIDE_M), (0.2, -0.1), 500.0, rotation(40.0, 2.0, 40.0)
    world, here_m = SlopedMap(ground, slope, amsl_m), np.array([10.0, -20.0])
    below_m = float(np.dot(slope, here_m))
    image = view(ground, PINHOLE, r, np.array([*here_m, below_m + AGL_M]), slope)
    believed = View(10.0, -20.0, r, AGL_M, amsl_m + below_m, float(np.radians(3.0)), 0.03, TILT_SIGMA_RAD, 0.0)
    estimator = ConsensusPose(FrameMatcher(PINHOLE, world, GradientDescriber()))  # type: ignore[arg-type]
    fix = estimator.estimate(image, believed)
    assert fix is not None and fix.pnp.fit is not None
    e_m, n_m, up_m = fix.points_w_m.T
    assert up_m == pytest.approx(amsl_m + slope[0] * e_m + slope[1] * n_m)
    assert np.ptp(up_m) > 4.0
    assert np.linalg.norm(fix.pnp.fit.p_c_in_w_m - [*here_m, amsl_m + below_m + AGL_M]) < 2.0
    assert np.degrees(np.linalg.norm(log_so3(r.T @ fix.pnp.fit.r_w_c))) < 1.0


def test_wrong_places_give_no_consensus_pose(estimator: ConsensusPose) -> None:
    for seed, away_m in enumerate([(60.0, -70.0), (50.0, 70.0), (-70.0, -60.0), (45.0, 0.0)]):
        image, _, believed_view = observation(texture(8, SIDE_M), seed)
        wrong = replace(believed_view, e_m=believed_view.e_m + away_m[0], n_m=believed_view.n_m + away_m[1])
        assert estimator.estimate(image, wrong) is None


def test_the_pose_has_no_tilt_prior(estimator: ConsensusPose) -> None:
    """The consumer of the pose already uses the predicted tilt; with a tilt prior it would count twice."""
    image, _, believed_view = observation(texture(8, SIDE_M), 0)
    fix = estimator.estimate(image, replace(believed_view, tilt_sigma_rad=1e-4))
    assert fix is not None and fix.pnp.fit is not None
    assert float(np.sqrt(fix.pnp.fit.cov[:2, :2].diagonal().min())) > 1e-3


def edge_between_fields(seed: int) -> np.ndarray:
    """Two fields with a straight edge through the middle, 25 degrees south of east; their crop (``seed``) differs from
    year to year."""
    side, turn = round(SIDE_M / GSD_M), np.radians(25.0)
    south, east = np.mgrid[0:side, 0:side] - side / 2
    edge = 90.0 + 70.0 / (1.0 + np.exp(-(east * np.sin(turn) - south * np.cos(turn)) * GSD_M))
    crop = cv2.GaussianBlur(np.random.default_rng(seed).normal(0.0, 1.0, (side, side)), (0, 0), 3.0)
    return np.dstack([np.clip(edge + 5.0 * crop / crop.std(), 0.0, 255.0).astype(np.uint8)] * 3)


def test_along_the_only_edge_of_the_ground_the_pose_claims_more_than_across_it() -> None:
    """The aperture problem: nothing but chance says where on the edge the camera is."""
    world = FlatMap(edge_between_fields(1))
    estimator = ConsensusPose(FrameMatcher(PINHOLE, world, GradientDescriber()))  # type: ignore[arg-type]
    along = np.array([np.cos(np.radians(25.0)), -np.sin(np.radians(25.0))])
    e_m, n_m = (float(v) for v in 10.0 * along)
    believed = View(e_m, n_m, R, AGL_M, 0.0, float(np.radians(3.0)), 0.03, TILT_SIGMA_RAD)
    image = view(edge_between_fields(2), PINHOLE, R, np.array([0.0, 0.0, AGL_M]))
    fix = estimator.estimate(image, believed)
    assert fix is not None and fix.pnp.fit is not None
    cov = (fix.pnp.fit.r_w_c @ fix.pnp.fit.cov[3:, 3:] @ fix.pnp.fit.r_w_c.T)[:2, :2]
    across = np.array([-along[1], along[0]])
    assert along @ cov @ along > across @ cov @ across
