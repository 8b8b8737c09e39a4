"""Corners found anew in another picture by their own patches: from frame to frame a track slips."""

import cv2
import numpy as np

WINDOW_PX = 21
BACK_PX = 0.5  # what does not come back to where it began is wrong (Kalal 2010)
LEVELS = 1  # patches are first bent as one plane would be, and then lie on each other within a pixel or two


def realigned(
    from_gray: np.ndarray, corners: np.ndarray, gray: np.ndarray, tracked: np.ndarray, most_off_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """``corners`` (N, 2) px of one picture, which were ``tracked`` to (N, 2) in another, within ``most_off_px``.
    -> where they really are there (M, 2), and which of them (M,). Tracks slip by 0.3 px in five frames and by 0.9 in
    sixteen; what this leaves is 0.15 px (docs/monte-carlo.md)."""
    h, _ = cv2.findHomography(corners, tracked, cv2.RANSAC, most_off_px, maxIters=1500, confidence=0.999)
    if h is None:
        return np.zeros((0, 2), np.float32), np.zeros(0, int)
    bent = cv2.warpPerspective(from_gray, h, gray.shape[::-1], borderMode=cv2.BORDER_REPLICATE)
    start = cv2.perspectiveTransform(corners.reshape(-1, 1, 2), h)
    guess = tracked.reshape(-1, 1, 2)
    here, found = _flow(bent, gray, start, guess)
    back, found_back = _flow(gray, bent, here, start)
    closed = np.linalg.norm((back - start).reshape(-1, 2), axis=1) < BACK_PX
    near = np.linalg.norm((here - guess).reshape(-1, 2), axis=1) < most_off_px
    keep = np.flatnonzero(found & found_back & closed & near)
    return here.reshape(-1, 2)[keep], keep


def _flow(a: np.ndarray, b: np.ndarray, points: np.ndarray, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """-> where the points (N, 1, 2) of one picture are in the other, and which were found (N,) bool."""
    there, ok, _ = cv2.calcOpticalFlowPyrLK(
        a,
        b,
        points,
        guess.copy(),
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=LEVELS,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(there), np.asarray(ok).ravel() == 1
