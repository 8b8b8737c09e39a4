"""The homography of most matches, whichever sample of them RANSAC draws first, and the spread over the image."""

import numpy as np
import pytest

from terrafix.vision.two_view import RANSAC_PX, fit_homography, homography_inliers, select_spread

SIZE_PX = (720, 405)
TRUE = np.array([[0.98, -0.05, 14.0], [0.04, 1.01, -9.0], [2e-5, -3e-5, 1.0]])


def matches(count: int, wrong: int, noise_px: float, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2), (N, 2) px float32, as KLT gives them; the first ``wrong`` of them are anywhere."""
    rng = np.random.default_rng(seed)
    a = rng.uniform((0, 0), SIZE_PX, (count, 2))
    mapped = np.column_stack([a, np.ones(count)]) @ TRUE.T
    b = mapped[:, :2] / mapped[:, 2:] + rng.normal(0.0, noise_px, (count, 2))
    b[:wrong] = rng.uniform((0, 0), SIZE_PX, (wrong, 2))
    return a.astype(np.float32), b.astype(np.float32)


def test_the_homography_does_not_depend_on_the_order_of_the_matches() -> None:
    """Another order is another sample for RANSAC; refined on the inliers of its best sample alone, a corner moved
    by 1.5 px."""
    a, b = matches(200, 60, 0.7)
    found = []
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(len(a))
        matrix = fit_homography(a[order], b[order], RANSAC_PX)
        assert matrix is not None
        corners = np.array([(0.0, 0.0, 1.0), (719.0, 0.0, 1.0), (719.0, 404.0, 1.0), (0.0, 404.0, 1.0)]) @ matrix.T
        found.append(corners[:, :2] / corners[:, 2:])
    assert np.ptp(found, axis=0).max() < 1e-2


def test_which_matches_agree_does_not_depend_on_their_order_but_at_the_threshold() -> None:
    a, b = matches(200, 60, 0.7)
    order = np.random.default_rng(9).permutation(len(a))
    one, other = homography_inliers(a, b), np.empty(len(a), bool)
    other[order] = homography_inliers(a[order], b[order])
    assert (one != other).sum() <= 1
    assert one[60:].mean() > 0.95 and one[:60].mean() < 0.1


def test_exact_matches_give_the_exact_homography() -> None:
    a, b = matches(40, 0, 0.0)
    matrix = fit_homography(a, b, RANSAC_PX)
    assert matrix is not None
    assert matrix / matrix[2, 2] == pytest.approx(TRUE, rel=1e-3, abs=1e-6)


def test_few_matches_and_matches_in_one_point_give_none_that_agree() -> None:
    a, b = matches(7, 0, 0.0)
    assert fit_homography(a, b, RANSAC_PX) is None
    assert not homography_inliers(a, b).any()
    same = np.zeros((20, 2), np.float32)
    homography_inliers(same, same)  # degenerate: any answer, no error


def test_one_point_more_at_the_border_selects_hardly_other_points() -> None:
    a, _ = matches(300, 0, 0.0)
    inner = a[(a > (30, 30)).all(axis=1) & (a < (690, 375)).all(axis=1)]
    more = np.vstack([inner, [(2.0, 3.0)]])
    one, other = (set(select_spread(points, 48, SIZE_PX).tolist()) for points in (inner, more))
    assert len(one) == len(other) == 48 and len(one - other) <= 1
