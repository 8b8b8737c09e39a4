"""Geometric verification: whether the matches of two images determine the motion between them.

From flying height the ground is close to a plane, so its matches agree with one homography. Points above the ground
fail the RANSAC threshold or add noise, which the covariance includes."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.vision.features import Matches

RANSAC_PX = 2.5  # 0.4 m from 100 m; excludes points above the ground
MIN_SPREAD = 0.12  # inliers must span this fraction of image width and height, else the pose is not determined
MIN_INLIERS = 15  # by chance, 4 to 8 of 100 wrong matches agree
MIN_INLIER_RATIO = 0.15


@dataclass(frozen=True)
class TwoView:
    """``a_px``, ``b_px`` (N, 2): matches that agree with one homography, out of ``matches``."""

    a_px: np.ndarray
    b_px: np.ndarray
    matches: int


def verify(matches: Matches, size_px: tuple[int, int]) -> TwoView | None:
    """The matches of two images of ``size_px`` (width, height) on one plane; None: they do not determine a motion."""
    inlier = homography_inliers(matches.a_px, matches.b_px)
    two_view = TwoView(matches.a_px[inlier], matches.b_px[inlier], len(matches))
    return two_view if determines_motion(two_view, size_px, MIN_INLIERS, MIN_INLIER_RATIO) else None


def determines_motion(two_view: TwoView, size_px: tuple[int, int], min_inliers: int, min_ratio: float) -> bool:
    """True when the inliers are enough and cover enough of both images."""
    count = len(two_view.a_px)
    if count < min_inliers or count < min_ratio * two_view.matches:
        return False
    return covers_image(two_view.a_px, size_px) and covers_image(two_view.b_px, size_px)


def covers_image(points: np.ndarray, size_px: tuple[int, int]) -> bool:
    """True when the points (N, 2) px cover enough of the image in both directions."""
    return bool(np.all(np.ptp(points, axis=0) > np.multiply(size_px, MIN_SPREAD)))


def homography_inliers(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) bool: matches (N, 2), (N, 2) px that agree with one RANSAC homography."""
    if len(a) < 8:
        return np.zeros(len(a), bool)
    _, mask = cv2.findHomography(a, b, cv2.RANSAC, RANSAC_PX, maxIters=1500, confidence=0.999)
    return np.zeros(len(a), bool) if mask is None else mask.ravel().astype(bool)


def select_spread(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, round-robin over an 8 x 6 grid, for an even distribution over the image."""
    if len(points) <= limit:
        return np.arange(len(points))
    low, span = points.min(0), np.maximum(np.ptp(points, axis=0), 1.0)
    cell = np.minimum((points - low) / span * (8, 6), (7, 5)).astype(int)
    key = cell[:, 1] * 8 + cell[:, 0]
    order = np.argsort(key, kind="stable")
    first = np.r_[True, np.diff(key[order]) > 0]
    rank = np.arange(len(order)) - np.maximum.accumulate(np.where(first, np.arange(len(order)), 0))
    return np.sort(order[np.argsort(rank, kind="stable")[:limit]])
