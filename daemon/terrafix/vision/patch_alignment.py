"""Sub-pixel re-detection of corners by patch alignment, because frame-to-frame tracks drift."""

import cv2
import numpy as np

from terrafix.vision.two_view import fit_homography

WINDOW_PX = 21
PATCH_RETURN_PX = 0.5  # forward-backward check (Kalal 2010)
PYRAMID_LEVELS = 1  # pyramid levels; patches are first warped by a homography and then match within a pixel or two


def align_patches(
    from_gray: np.ndarray, corners: np.ndarray, gray: np.ndarray, tracked: np.ndarray, max_shift_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Aligns corners of one image in another. ``corners`` (N, 2) px; ``tracked`` (N, 2) px: their approximate positions
    in ``gray``, within ``max_shift_px``. -> refined positions (M, 2) px and their indices (M,).

    Tracks drift by 0.3 px in five frames and by 0.9 px in sixteen; the error after alignment is 0.15 px
    (docs/monte-carlo.md)."""
    h = fit_homography(corners, tracked, max_shift_px)
    if h is None:
        return np.zeros((0, 2), np.float32), np.zeros(0, int)
    warped = cv2.warpPerspective(from_gray, h, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    start = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), h)
    guess = tracked.reshape(-1, 1, 2)
    aligned, found = _flow(warped, gray, start, guess)
    back, found_back = _flow(gray, warped, aligned, start)
    closed = np.linalg.norm((back - start).reshape(-1, 2), axis=1) < PATCH_RETURN_PX
    near = np.linalg.norm((aligned - guess).reshape(-1, 2), axis=1) < max_shift_px
    keep = np.flatnonzero(found & found_back & closed & near)
    return aligned.reshape(-1, 2)[keep], keep


def _flow(a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lucas-Kanade flow from an initial guess. -> positions (N, 1, 2) px in ``b``, found (N,) bool."""
    flowed, ok, _ = cv2.calcOpticalFlowPyrLK(
        a,
        b,
        points,
        guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=PYRAMID_LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(flowed), np.asarray(ok).ravel() == 1
