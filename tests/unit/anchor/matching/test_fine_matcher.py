"""The last step of a map fix: smaller errors of the matches, the relief of the ground, and what it refuses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from terrafix.anchor.matching.fine_matcher import KEPT_PLACES, MAX_PLACES, _isotropy, _peak
from terrafix.anchor.matching.frame_matcher import Fix, FrameMatcher, Hypothesis, View
from terrafix.core.pose import exp_so3
from terrafix.messages import Verdict
from terrafix_engines.features.gradient import GradientDescriber, OrientationDescriber
from textured_ground import PINHOLE, FlatMap, SlopedMap, rotation, texture, view

AGL_M = 100.0
TRUE_M = np.array([22.0, -31.0, AGL_M])
TRUE_R = rotation(40.0, 4.0, -6.0)
SLOPE = (0.16, -0.1)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return texture(8, 480.0)


@pytest.fixture(scope="module")
def changed(ground: np.ndarray) -> np.ndarray:
    """The ground at another date: other contrast, and other things on a third of it."""
    other = texture(21, 480.0)
    side = len(ground)
    where = cv2.resize(np.random.default_rng(3).normal(size=(40, 40)).astype(np.float32), (side, side)) > 0.45
    return np.where(where[..., None], other, 255 - ground)


def fixes(frame: np.ndarray, source: FlatMap, at_m: np.ndarray = TRUE_M) -> tuple[Fix, Fix | None]:
    """-> the fix of single patches from a prediction that is off by a degree and metres, and the fine one."""
    matcher = FrameMatcher(PINHOLE, source, GradientDescriber())  # type: ignore[arg-type]
    r = TRUE_R @ exp_so3(np.radians([0.7, -0.7, 1.0]))
    predicted = View(0.0, 0.0, r, AGL_M * 1.02, float(at_m[2]) - AGL_M, 0.02, 0.02, 0.02)
    coarse = matcher.fix(frame, predicted, Hypothesis(0.0, 1.0), float(at_m[0]) + 2.0, float(at_m[1]) - 2.0)
    assert coarse is not None and coarse.pnp.verdict is Verdict.ACCEPTED
    return coarse, matcher.fine_fix(frame, predicted, coarse)


def mean_px(fix: Fix) -> float:
    assert fix.pnp.fit is not None
    return float(fix.pnp.fit.residuals.mean()) * PINHOLE.fx


def test_fine_matches_leave_two_thirds_of_the_error_at_most_where_the_ground_has_changed(
    ground: np.ndarray, changed: np.ndarray
) -> None:
    coarse, fine = fixes(view(ground, PINHOLE, TRUE_R, TRUE_M), FlatMap(changed))
    assert fine is not None and fine.pnp.fit is not None and coarse.pnp.fit is not None
    assert mean_px(fine) < 0.67 * mean_px(coarse)
    assert mean_px(fine) < 0.2
    assert np.linalg.norm(fine.pnp.fit.p_c_in_w_m - TRUE_M) < 0.3
    assert 9 <= fine.pnp.inliers.sum() <= KEPT_PLACES < MAX_PLACES
    error = np.concatenate([np.zeros(3), fine.pnp.fit.r_w_c.T @ (fine.pnp.fit.p_c_in_w_m - TRUE_M)])
    assert error[3:] @ np.linalg.solve(fine.pnp.fit.cov[3:, 3:], error[3:]) < 16.3  # chi-square, 3 degrees, 99.9 %


def test_the_relief_of_the_map_is_in_the_warp_and_in_the_points(ground: np.ndarray) -> None:
    """Over a slope of a fifth, patches on one plane would be off by metres at the border of the frame."""
    ground_m = float(SLOPE[0] * TRUE_M[0] + SLOPE[1] * TRUE_M[1])
    at_m = TRUE_M + np.array([0.0, 0.0, ground_m])
    sloped = SlopedMap(ground, SLOPE, 0.0)
    _, fine = fixes(view(ground, PINHOLE, TRUE_R, at_m, SLOPE), sloped, at_m)
    assert fine is not None and fine.pnp.fit is not None
    assert fine.points_w_m[:, 2] == pytest.approx(sloped.elevation(*fine.points_w_m[:, :2].T), abs=1e-6)
    in_c = (fine.points_w_m - at_m) @ TRUE_R
    error_px = np.linalg.norm(in_c[:, :2] / in_c[:, 2:] - fine.xy, axis=1) * PINHOLE.fx
    assert np.median(error_px) < 0.35
    assert np.linalg.norm(fine.pnp.fit.p_c_in_w_m - at_m) < 0.5


def test_another_place_has_no_fine_fix(ground: np.ndarray) -> None:
    frame = view(ground, PINHOLE, TRUE_R, TRUE_M)
    coarse, _ = fixes(frame, FlatMap(ground))
    assert coarse.pnp.fit is not None
    matcher = FrameMatcher(PINHOLE, FlatMap(texture(30, 480.0)), GradientDescriber())  # type: ignore[arg-type]
    predicted = View(22.0, -31.0, TRUE_R, AGL_M, 0.0, 0.02, 0.02, 0.02)
    assert matcher.fine_fix(frame, predicted, coarse) is None
    off_map = replace(coarse.pnp.fit, p_c_in_w_m=TRUE_M + np.array([900.0, 0.0, 0.0]))
    away = replace(coarse, pnp=replace(coarse.pnp, fit=off_map))
    assert matcher.fine_fix(frame, predicted, away) is None


def surface(row: float, column: float, along: float, across: float) -> np.ndarray:
    """Correlation peak of 0.8 with these curvatures by column and row."""
    y, x = np.mgrid[0:17, 0:17]
    return np.asarray(0.8 - 0.5 * along * (x - column) ** 2 - 0.5 * across * (y - row) ** 2)


def test_a_peak_is_located_between_the_cells_and_its_sigma_is_that_of_the_flat_direction() -> None:
    found = _peak(surface(8.3, 6.6, 0.08, 0.02))
    assert found is not None
    assert found[:2] == pytest.approx((8.3, 6.6), abs=1e-6)
    best = float(surface(8.3, 6.6, 0.08, 0.02).max())
    assert found[2:] == pytest.approx((best, np.sqrt((1.0 - best**2) / (best * 0.02))), rel=1e-6)


@pytest.mark.parametrize(("row", "column", "across"), [(0.0, 8.0, 0.02), (8.0, 16.0, 0.02), (8.0, 8.0, 0.0)])
def test_a_peak_at_the_border_or_along_a_ridge_is_no_match(row: float, column: float, across: float) -> None:
    assert _peak(surface(row, column, 0.08, across)) is None


def test_places_on_one_edge_rank_below_those_with_a_corner() -> None:
    image = np.full((80, 160), 60, np.uint8)
    image[:, 40:80] = 200  # an edge along the whole patch at columns 20 to 60
    image[40:, 120:] = 200  # a corner in the patch at columns 100 to 140
    template = OrientationDescriber().describe(cv2.GaussianBlur(image, (0, 0), 1.0))
    edge, corner = _isotropy(template, 40, np.array([[20, 20], [20, 100]]))
    assert corner > 0.05 and abs(edge) < 0.1 * corner


def test_the_orientation_does_not_depend_on_the_sign_of_the_contrast(ground: np.ndarray) -> None:
    image = ground[:120, :160]
    describer = OrientationDescriber()
    mine, inverted = describer.describe(image), describer.describe(255 - image)
    assert mine.shape == (2, 120, 160) and float(np.hypot(*mine).max()) < 1.0
    assert np.abs(mine - inverted).mean() < 0.01 < 0.2 < np.abs(mine).mean()
