"""Correlation of several patches of the rectified frame with the map: the 2D-3D matches of a frame."""

from dataclasses import dataclass

import cv2
import numpy as np

from terrafix.anchor.matching.fft import as_complex, conjugate_spectrum, cross_correlation, pairs, transform_shape
from terrafix.anchor.matching.ncc import FLAT_VARIANCE
from terrafix.anchor.matching.orthorectify import Rectified

MAX_PATCHES = 48  # patches per frame [tuned]
# Share of a patch that lies in the frame: from the first on it counts, and inside it has its full weight
LEAST_INSIDE = 0.96  # [spec: two of the 50 cells of its side are outside]
# Share from which a patch has its full weight by having more texture than the first that is left out
MORE_TEXTURE = 0.05  # [spec: 1 % of the texture changes a weight by a fifth]
MIN_PATCH_CORRELATION = 0.2  # correlation at the peak below which a patch is rejected as noise [tuned]
# standard deviations of the patch's surface between the peak and the second peak; less is ambiguous [tuned]
MIN_MARGIN = 0.35
# From these a peak has its full weight: correlation, and margin in MIN_MARGIN; between them and the least ones the
# weight rises from zero, as it does over BORDER_CELLS from the border of the search
# [measured: docs/decisions/049]
FULL_CORRELATION, FULL_MARGIN = 0.25, 1.5
BORDER_CELLS = 1.5  # [measured: docs/decisions/049]
PEAK_RADIUS = 3  # cells around the peak that are excluded from the search for the second peak [tuned]


@dataclass(frozen=True)
class PatchMatches:
    """``frame_m`` (N, 2): patch centre in the rectified frame, east and north of the nadir point; ``map_m`` (N, 2): the
    matched point on the map, local east and north; ``weight`` (N,) in (0, 1]."""

    frame_m: np.ndarray
    map_m: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class SearchedMap:
    """``cells`` (C, H, W) and ``valid`` (H, W) describe the map from its corner ``corner_m`` (e_min, n_max) on."""

    cells: np.ndarray
    valid: np.ndarray
    corner_m: tuple[float, float]


def match_patches(
    template: np.ndarray,
    rectified: Rectified,
    cells_mask: np.ndarray,
    cell_m: float,
    searched: SearchedMap,
    camera_m: tuple[float, float],
    patch_cells: int,
    radius_cells: int,
    centres: np.ndarray | None = None,
) -> PatchMatches:
    """``template`` (C, h, w) and ``cells_mask`` (h, w) describe the rectified frame. ``camera_m``: predicted east and
    north of the camera. Each patch is searched within ``radius_cells`` of its predicted place. ``centres``: as in
    ``correlate_patches``."""
    # Cell of the window at which the template's corner is expected.
    e_min_m, n_max_m = searched.corner_m
    row0_exact = (n_max_m - (camera_m[1] + rectified.n_max_m)) / cell_m
    column0_exact = ((camera_m[0] + rectified.e_min_m) - e_min_m) / cell_m
    row0, column0 = round(row0_exact), round(column0_exact)
    corners, shares, surfaces = correlate_patches(
        template, cells_mask, searched.cells, searched.valid, patch_cells, radius_cells, row0, column0, centres
    )
    peaks = _peaks(surfaces, np.array([row0_exact - row0, column0_exact - column0]))
    half = patch_cells / 2.0
    places = np.array([corners[i] for i in peaks.index], dtype=float).reshape(-1, 2) + half  # row, column
    found = places + np.array([row0, column0]) - radius_cells + peaks.place
    return PatchMatches(
        np.column_stack([rectified.e_min_m + places[:, 1] * cell_m, rectified.n_max_m - places[:, 0] * cell_m]),
        np.column_stack([e_min_m + found[:, 1] * cell_m, n_max_m - found[:, 0] * cell_m]),
        peaks.weight * shares[peaks.index],
    )


def correlate_patches(
    template: np.ndarray,
    mask: np.ndarray,
    window: np.ndarray,
    valid: np.ndarray,
    patch: int,
    radius: int,
    row0: int,
    column0: int,
    centres: np.ndarray | None = None,
) -> tuple[list[tuple[int, int]], np.ndarray, np.ndarray]:
    """Corners (row, column) of patches of the template, the weight (N,) with which each counts, and their correlation
    surfaces (N, 2 radius + 1, 2 radius + 1), centred on the place that follows from the template's corner at cell
    (row0, column0) of the window. ``centres`` (M, 2): row and column of the patches to choose from, in cells; None: on
    a grid of the template."""
    corners, weights = _select_patches(template, mask, valid, patch, radius, row0, column0, centres)
    side = 2 * radius + 1
    if not corners:
        return corners, weights, np.zeros((0, side, side))
    return corners, weights, _correlate(template, window, corners, patch, radius, row0, column0)


def _select_patches(
    template: np.ndarray,
    mask: np.ndarray,
    valid: np.ndarray,
    patch: int,
    radius: int,
    row0: int,
    column0: int,
    centres: np.ndarray | None,
) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Corners of patches that lie inside the frame and whose search area lies on the map, the ones with most texture
    first, at most ``MAX_PATCHES``, and their weights: one that leaves the frame, or has hardly more texture than the
    first that is left out, counts little, so that no match hangs on the last bit of either."""
    h, w = mask.shape
    if h < patch or w < patch:
        return [], np.zeros(0)
    inside = cv2.boxFilter(mask.astype(np.float32), -1, (patch, patch), anchor=(0, 0), normalize=True)
    energy = np.einsum("khw,khw->hw", template, template)
    texture = cv2.boxFilter(energy, -1, (patch, patch), anchor=(0, 0), normalize=True)
    is_all_valid = bool(valid.all())
    found: list[tuple[float, int, int]] = []
    for r, c in _corners(h, w, patch, centres).tolist():
        top, left = row0 + r - radius, column0 + c - radius
        bottom, right = row0 + r + patch + radius, column0 + c + patch + radius
        if inside[r, c] <= LEAST_INSIDE or top < 0 or left < 0 or bottom > valid.shape[0] or right > valid.shape[1]:
            continue
        if is_all_valid or valid[top:bottom:4, left:right:4].all():
            found.append((float(texture[r, c]), r, c))
    found.sort(reverse=True)
    most = found[MAX_PATCHES][0] if len(found) > MAX_PATCHES else 0.0
    weights = [
        min((inside[r, c] - LEAST_INSIDE) / (1.0 - LEAST_INSIDE), (one - most) / max(MORE_TEXTURE * most, 1e-12), 1.0)
        for one, r, c in found[:MAX_PATCHES]
    ]
    return [(r, c) for _, r, c in found[:MAX_PATCHES]], np.array(weights)


def _corners(height: int, width: int, patch: int, centres: np.ndarray | None) -> np.ndarray:
    """(N, 2) row and column of the corners of patches that lie in (height, width) cells, as in
    ``correlate_patches``."""
    if centres is None:
        step = max(patch // 2, 1)
        rows, columns = np.mgrid[0 : height - patch + 1 : step, 0 : width - patch + 1 : step]
        return np.column_stack([rows.ravel(), columns.ravel()])
    corners = np.rint(centres - patch / 2.0).astype(int)
    return np.asarray(corners[((corners >= 0) & (corners <= (height - patch, width - patch))).all(axis=1)])


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
    (height, width), spare = window.shape[1:], (fft[0] - side, fft[1] - side)
    # The transform of a search area takes the map around it instead of zeros: what wraps around lies beyond the n
    # places of the patch, and no area is copied.
    areas = pairs(window, (height + spare[0], width + spare[1]))
    patches = pairs(template, conjugate=True)
    padded = np.zeros((len(patches), *fft, 2), np.float32)
    inside = padded[:, :patch, :patch]
    area_spectra, patch_spectra = np.empty_like(padded), np.empty_like(padded)
    images, templates = as_complex(area_spectra), as_complex(patch_spectra)
    surfaces = np.empty((len(corners), n, n), np.float32)
    own, under = np.empty((len(corners), 1, 1), np.float32), np.empty_like(surfaces)
    count, channels = patch * patch, len(window)
    area_sums = np.stack([_box_sums(channel, patch) for channel in window])
    variance = _box_sums(np.einsum("khw,khw->hw", window, window), patch)
    variance -= np.einsum("khw,khw->hw", area_sums, area_sums) / count
    for i, (r, c) in enumerate(corners):
        top, left = row0 + r - radius, column0 + c - radius
        np.copyto(inside, patches[:, r : r + patch, c : c + patch])
        for k, of_patch in enumerate(padded):
            conjugate_spectrum(of_patch, patch_spectra[k])
            cv2.dft(areas[k, top : top + fft[0], left : left + fft[1]], area_spectra[k])
        # The patch less its mean, without a pass over the patch: the first cell of a spectrum is the sum.
        sums = patch_spectra[:, 0, 0] * (1.0, -1.0)
        means = sums.ravel()[:channels] / count
        places = (slice(top, top + n), slice(left, left + n))
        surfaces[i] = cross_correlation(images, templates)[:n, :n]
        surfaces[i] -= np.einsum("k,khw->hw", means, area_sums[:, *places])
        own[i] = np.vdot(padded, padded) - count * np.vdot(means, means)
        under[i] = variance[places]
    surfaces /= np.sqrt(np.maximum(np.maximum(under, FLAT_VARIANCE * own) * own, 1e-12))
    return surfaces


def _box_sums(x: np.ndarray, side: int) -> np.ndarray:
    """(H, W): sum over the square of ``side`` cells whose corner is the cell, zero outside of ``x``."""
    return cv2.boxFilter(x, -1, (side, side), anchor=(0, 0), normalize=False, borderType=cv2.BORDER_CONSTANT)


@dataclass(frozen=True)
class _Peaks:
    """Surfaces with a peak inside that is neither weak nor ambiguous: their ``index`` (M,), the ``place`` (M, 2) of the
    peak as row and column between the cells, and its ``weight`` (M,)."""

    index: np.ndarray
    place: np.ndarray
    weight: np.ndarray


def _peaks(surfaces: np.ndarray, expected: np.ndarray) -> _Peaks:
    """``surfaces`` (N, n, n) -> their peaks. ``expected`` (2,): row and column, in cells from the centre of a surface,
    of the place that was predicted. The weight falls to zero where a peak would no longer count: one that is as high as
    another, or at the border of the search, may be gone by the rounding of the next processor."""
    count, n, _ = surfaces.shape
    if count == 0:
        return _Peaks(np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    r, c = np.divmod(surfaces.reshape(count, -1).argmax(axis=1), n)
    every = np.arange(count)
    best = surfaces[every, r, c]
    elsewhere = surfaces.copy()
    for other, row, column in zip(elsewhere, r.tolist(), c.tolist(), strict=True):
        rows = slice(max(row - PEAK_RADIUS, 0), row + PEAK_RADIUS + 1)
        other[rows, max(column - PEAK_RADIUS, 0) : column + PEAK_RADIUS + 1] = -1.0
    margin = best - elsewhere.max(axis=(1, 2))
    is_inside = (np.minimum(r, c) > 0) & (np.maximum(r, c) < n - 1)
    clear = margin / np.maximum(MIN_MARGIN * surfaces.std(axis=(1, 2)), 1e-9)
    index = np.flatnonzero(is_inside & (best >= MIN_PATCH_CORRELATION) & (clear >= 1.0))
    i, r, c, best = index, r[index], c[index], best[index].astype(float)
    rows = r + _vertex(surfaces[i, r - 1, c], best, surfaces[i, r + 1, c])
    columns = c + _vertex(surfaces[i, r, c - 1], best, surfaces[i, r, c + 1])
    place = np.column_stack([rows, columns])
    to_border = (n // 2 - 1.5 - np.abs(place - n // 2 - expected)) / BORDER_CELLS
    fade = np.clip((clear[i] - 1.0) / (FULL_MARGIN - 1.0), 0.0, 1.0)
    fade *= np.clip((best - MIN_PATCH_CORRELATION) / (FULL_CORRELATION - MIN_PATCH_CORRELATION), 0.0, 1.0)
    fade *= np.clip(to_border, 0.0, 1.0).prod(axis=1)
    used = fade > 0.0
    return _Peaks(i[used], place[used], (best**2 * fade)[used])


def _vertex(before: np.ndarray, here: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Extremum of the parabola through three neighbouring values, in cells relative to the central one, within +-
    0.5."""
    curvature = np.minimum(before - 2.0 * here + after, -1e-9)
    return np.clip(0.5 * (before - after) / curvature, -0.5, 0.5)
