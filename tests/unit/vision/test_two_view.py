"""Two views: which matches are on the ground, over relief, and which pairs of images determine no motion."""

import cv2
import numpy as np
import pytest

from terrafix.core.camera import CameraCalibration, Mount
from terrafix.vision.features import Features, Matches, SiftMatcher, mutual_nearest
from terrafix.vision.two_view import TWO_VIEW_MIN_INLIERS, TwoViewGeometry

CAMERA = CameraCalibration(720, 405, 524.0, 524.0, 359.5, 202.0)
AGL_M = 120.0
NOISE_PX = 0.4


def rotated(axis: int, angle_deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    first, second = [k for k in range(3) if k != axis]
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = c
    matrix[first, second], matrix[second, first] = -s, s
    return matrix


def seen(points_m: np.ndarray, r: np.ndarray, at_m: np.ndarray) -> np.ndarray:
    """Pixels of points (N, 3) of the first camera in one with rotation ``r`` (camera to first) at ``at_m``."""
    return CAMERA.project((points_m - at_m) @ r)


def matched(points_m: np.ndarray, r: np.ndarray, at_m: np.ndarray, wrong: int = 0) -> Matches:
    """Matches of points (N, 3), and ``wrong`` ones more."""
    rng = np.random.default_rng(5)
    a, b = seen(points_m, np.eye(3), np.zeros(3)), seen(points_m, r, at_m)
    a, b = (xy + rng.normal(0.0, NOISE_PX, xy.shape) for xy in (a, b))
    chance = [rng.uniform((0, 0), (720, 405), (wrong, 2)) for _ in range(2)]
    a, b = np.vstack([a, chance[0]]).astype(np.float32), np.vstack([b, chance[1]]).astype(np.float32)
    return Matches(a, b)


def ground_points(count: int, mount_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Ground points (N, 3) [m] in the axes of a camera that is tilted by ``mount_deg``, and the normal (3,) down."""
    rng = np.random.default_rng(8)
    down = rotated(0, mount_deg).T @ np.array([0.0, 0.0, 1.0])
    rays = np.column_stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.33, 0.33, count), np.ones(count)])
    return rays * (AGL_M / (rays @ down))[:, None], down


def town(mount_deg: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """-> points (N, 3) and (N,) bool, on the ground: 60 of 200. The others are roofs; 70 of these lie on a plane that
    rises by 20 degrees across the image, as terraces do."""
    rng = np.random.default_rng(9)
    points, _ = ground_points(200, mount_deg)
    share, slope = np.ones(200), np.tan(np.radians(20.0))
    across = points[60:130, 0] / points[60:130, 2]
    share[60:130] = (1.0 - 0.6 * slope) / (1.0 + slope * across)
    share[130:] = rng.uniform(0.75, 0.97, 70)
    return points * share[:, None], np.arange(200) < 60


MOTION = rotated(2, 8.0), np.array([10.0, 45.0, 3.0])


def test_over_roofs_the_level_ground_is_found_and_not_the_slanted_plane_with_more_matches() -> None:
    points, ground = town()
    matches = matched(points, *MOTION)
    two_view = TwoViewGeometry(CAMERA).verify(matches)
    assert two_view is not None
    chosen = (matches.a_px[:, None] == two_view.a_px).all(axis=2).any(axis=1)
    assert (chosen & ground).sum() >= 50 and (chosen & ~ground).sum() <= 12
    assert len(two_view.lines_a_px) > 180  # points at every height agree with the motion


def test_below_an_oblique_camera_the_level_ground_is_that_of_its_mount() -> None:
    points, ground = town(mount_deg=-30.0)
    two_view = TwoViewGeometry(CAMERA, Mount(pitch_deg=-60.0)).verify(matched(points, *MOTION))
    assert two_view is not None
    a = seen(points, np.eye(3), np.zeros(3))
    nearest = np.linalg.norm(two_view.a_px[:, None] - a, axis=2).argmin(axis=1)
    assert ground[nearest].mean() > 0.8


def test_without_relief_all_right_matches_are_inliers_and_wrong_ones_are_not() -> None:
    points, _ = ground_points(120)
    two_view = TwoViewGeometry(CAMERA).verify(matched(points, *MOTION, wrong=60))
    assert two_view is not None
    assert 110 <= len(two_view.a_px) <= 125 and two_view.matches == 180


@pytest.mark.parametrize("r", [np.eye(3), rotated(2, 20.0)])
def test_images_from_one_place_have_a_motion(r: np.ndarray) -> None:
    """No parallax: the essential matrix is not determined."""
    points, _ = ground_points(100)
    two_view = TwoViewGeometry(CAMERA).verify(matched(points, r, np.zeros(3)))
    assert two_view is not None and len(two_view.a_px) > 90


@pytest.mark.parametrize("seed", range(12))
def test_wrong_matches_have_no_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (rng.uniform((0, 0), (720, 405), (90, 2)).astype(np.float32) for _ in range(2))
    geometry = TwoViewGeometry(CAMERA)
    assert geometry.verify(Matches(a, b)) is None
    assert len(geometry.fit(Matches(a, b)).a_px) < TWO_VIEW_MIN_INLIERS


def test_matches_in_a_corner_of_the_image_determine_no_motion() -> None:
    points, _ = ground_points(6000)
    corner = points[(points[:, 0] < -60.0) & (points[:, 1] < -30.0)]
    assert len(corner) > 40
    assert TwoViewGeometry(CAMERA).verify(matched(corner, *MOTION)) is None


def test_each_feature_is_in_one_pair_at_most() -> None:
    """Twenty features of the first image are nearest to one of the second."""
    rng = np.random.default_rng(1)
    one, far = rng.uniform(0.0, 100.0, (1, 128)), rng.uniform(0.0, 255.0, (30, 128))
    first = np.vstack([one + rng.normal(0.0, 1.0, (20, 128)), far]).astype(np.float32)
    second = np.vstack([one, far]).astype(np.float32)
    a, b = mutual_nearest(first, second)
    assert len(a) == 31 and len(set(b)) == 31 and (b == 0).sum() == 1


def test_coarse_features_are_the_strongest_large_ones_in_pixels_of_the_smaller_image() -> None:
    xy = np.arange(20.0).reshape(10, 2).astype(np.float32)
    size = np.array([2.0, 4.0] * 5, np.float32)
    features = Features(xy, np.zeros((10, 128), np.float32), size)
    coarse = features.coarse(0.5, 3)
    assert coarse.size_px.tolist() == [2.0, 2.0, 2.0]
    assert np.allclose(coarse.xy_px, (xy[[1, 3, 5]] + 0.5) * 0.5 - 0.5)


def test_the_strongest_feature_is_the_first() -> None:
    """A sharp blob and a faint one."""
    y, x = np.mgrid[0:120, 0:160]
    image = np.full((120, 160), 60.0)
    for (cx, cy), height in (((40, 60), 150.0), ((120, 60), 25.0)):
        image += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 32.0)
    features = SiftMatcher(10).describe(image.astype(np.uint8))
    assert len(features) >= 2
    assert np.allclose(features.xy_px[0], (40, 60), atol=1.0)


def test_the_motion_of_a_few_matches_is_searched_for_shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    draws = list[int]()
    monkeypatch.setattr(cv2, "findEssentialMat", lambda *a: (draws.append(a[-1]), (None, None))[1])
    for count in (15, 30, 60):
        TwoViewGeometry(CAMERA).fit(Matches(*np.random.default_rng(1).uniform(0.0, 400.0, (2, count, 2))))
    assert draws == [100, 217, 3000]  # five of 15 right ones, in 99.9 %
