"""Correlation of several patches of the rectified frame with the map: the 2D-3D matches of a frame."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.anchor.matching.fft import cross_correlation, spectra, transform_shape
from terrafix.anchor.matching.orthorectify import Rectified

MAX_PATCHES = 48  # patches per frame [tuned]
MIN_CORRELATION = 0.2  # correlation at the peak below which a patch is rejected as noise [tuned]
# standard deviations of the patch's surface between the peak and the second peak; less is ambiguous [tuned]
MIN_MARGIN = 0.35
PEAK_RADIUS = 3  # cells around the peak that are excluded from the search for the second peak [tuned]


@dataclass(frozen=True)
class PatchMatches:
    """``frame_m`` (N, 2): patch centre in the rectified frame, east and north of the nadir point; ``map_m`` (N, 2): the
    matched point on the map, local east and north; ``weight`` (N,) in (0, 1]."""

    frame_m: np.ndarray
    map_m: np.ndarray
    weight: np.ndarray


def match_patches(
    template: np.ndarray,
    rectified: Rectified,
    cells_mask: np.ndarray,
    cell_m: float,
    window: np.ndarray,
    valid: np.ndarray,
    window_corner_m: tuple[float, float],
    camera_m: tuple[float, float],
    patch_cells: int,
    radius_cells: int,
) -> PatchMatches:
    """``template`` (C, h, w) and ``cells_mask`` (h, w) describe the rectified frame; ``window`` (C, H, W) and ``valid``
    (H, W) the map, with its corner at (e_min, n_max). ``camera_m``: predicted east and north of the camera. Each patch
    is searched within ``radius_cells`` of its predicted place."""
    # Cell of the window at which the template's corner is expected.
    row0 = round((window_corner_m[1] - (camera_m[1] + rectified.n_max_m)) / cell_m)
    column0 = round(((camera_m[0] + rectified.e_min_m) - window_corner_m[0]) / cell_m)
    corners, surfaces = correlate_patches(template, cells_mask, window, valid, patch_cells, radius_cells, row0, column0)
    if len(corners) == 0:
        return PatchMatches(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    frame_m, map_m, weights = [], [], []
    for (r, c), surface in zip(corners, surfaces, strict=True):
        peak = _peak(surface)
        if peak is None:
            continue
        dy, dx, weight = peak
        half = patch_cells / 2.0
        frame_m.append((rectified.e_min_m + (c + half) * cell_m, rectified.n_max_m - (r + half) * cell_m))
        map_m.append(
            (
                window_corner_m[0] + (column0 + c + half + dx - radius_cells) * cell_m,
                window_corner_m[1] - (row0 + r + half + dy - radius_cells) * cell_m,
            )
        )
        weights.append(weight)
    return PatchMatches(np.array(frame_m).reshape(-1, 2), np.array(map_m).reshape(-1, 2), np.array(weights))


def correlate_patches(
    template: np.ndarray,
    mask: np.ndarray,
    window: np.ndarray,
    valid: np.ndarray,
    patch: int,
    radius: int,
    row0: int,
    column0: int,
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Corners (row, column) of patches of the template and their correlation surfaces (N, 2 radius + 1, 2 radius + 1),
    centred on the place that follows from the template's corner at cell (row0, column0) of the window."""
    corners = _select_patches(template, mask, valid, patch, radius, row0, column0)
    side = 2 * radius + 1
    if not corners:
        return corners, np.zeros((0, side, side))
    return corners, _correlate(template, window, corners, patch, radius, row0, column0)


def _select_patches(
    template: np.ndarray,
    mask: np.ndarray,
    valid: np.ndarray,
    patch: int,
    radius: int,
    row0: int,
    column0: int,
) -> list[tuple[int, int]]:
    """Corners of patches that lie inside the frame and whose search area lies on the map, the ones with most texture
    first, at most ``MAX_PATCHES``."""
    h, w = mask.shape
    if h < patch or w < patch:
        return []
    step = max(patch // 2, 1)
    inside = cv2.boxFilter(mask.astype(np.float32), -1, (patch, patch), anchor=(0, 0), normalize=True)
    energy = np.einsum("khw,khw->hw", template, template)
    texture = cv2.boxFilter(energy, -1, (patch, patch), anchor=(0, 0), normalize=True)
    found: list[tuple[float, int, int]] = []
    for r in range(0, h - patch + 1, step):
        for c in range(0, w - patch + 1, step):
            if inside[r, c] < 0.98:
                continue
            top, left = row0 + r - radius, column0 + c - radius
            bottom, right = row0 + r + patch + radius, column0 + c + patch + radius
            if top < 0 or left < 0 or bottom > valid.shape[0] or right > valid.shape[1]:
                continue
            if valid[top:bottom:4, left:right:4].all():
                found.append((float(texture[r, c]), r, c))
    found.sort(reverse=True)
    return [(r, c) for _, r, c in found[:MAX_PATCHES]]


def _correlate(
    template: np.ndarray,
    window: np.ndarray,
    corners: list[tuple[int, int]],
    patch: int,
    radius: int,
    row0: int,
    column0: int,
) -> np.ndarray:
    """Zero-mean normalised correlation surface of every patch, (N, 2 radius + 1, 2 radius + 1)."""
    side = patch + 2 * radius
    fft = transform_shape(side, side)
    n = 2 * radius + 1
    product = np.empty((len(corners), n, n), np.float32)
    own = np.empty(len(corners))
    for i, (r, c) in enumerate(corners):
        small = template[:, r : r + patch, c : c + patch]
        small = small - small.mean(axis=(1, 2), keepdims=True)
        own[i] = (small**2).sum()
        top, left = row0 + r - radius, column0 + c - radius
        large = window[:, top : top + side, left : left + side]
        product[i] = cross_correlation(spectra(large, fft), spectra(small, fft))[:n, :n]
    # Energy and channel means of the map under every placement of a patch, by box sums over the whole window.
    count = patch * patch
    variance = _box_sums(np.einsum("khw,khw->hw", window, window), patch)
    for channel in window:
        variance -= _box_sums(channel, patch) ** 2 / count
    under = np.stack([variance[row0 + r - radius :, column0 + c - radius :][:n, :n] for r, c in corners])
    floor = 0.05 * own[:, None, None]
    return product / np.sqrt(np.maximum(np.maximum(under, floor) * own[:, None, None], 1e-12))


def _box_sums(x: np.ndarray, side: int) -> np.ndarray:
    """(H, W): sum over the square of ``side`` cells whose corner is the cell, zero outside of ``x``."""
    box = (side, side)
    return cv2.boxFilter(x, cv2.CV_64F, box, anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _peak(surface: np.ndarray) -> tuple[float, float, float] | None:
    """(row, column, weight) of the peak with sub-cell interpolation; None: at the border, weak or ambiguous."""
    r, c = np.unravel_index(int(np.argmax(surface)), surface.shape)
    if r in (0, surface.shape[0] - 1) or c in (0, surface.shape[1] - 1):
        return None
    best = float(surface[r, c])
    elsewhere = surface.copy()
    elsewhere[max(r - PEAK_RADIUS, 0) : r + PEAK_RADIUS + 1, max(c - PEAK_RADIUS, 0) : c + PEAK_RADIUS + 1] = -1.0
    spread = float(surface.std())
    if best < MIN_CORRELATION or best - float(elsewhere.max()) < MIN_MARGIN * spread:
        return None
    dy = _vertex(surface[r - 1, c], best, surface[r + 1, c])
    dx = _vertex(surface[r, c - 1], best, surface[r, c + 1])
    return float(r) + dy, float(c) + dx, best * best


def _vertex(before: float, here: float, after: float) -> float:
    """Extremum of the parabola through three neighbouring values, in cells relative to the central one, within +-
    0.5."""
    curvature = before - 2.0 * here + after
    return 0.0 if curvature >= -1e-9 else float(np.clip(0.5 * (before - after) / curvature, -0.5, 0.5))
