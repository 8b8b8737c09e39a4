"""Evidence of one frame for a place: agreement of its patches with the map under one common motion of the camera.

Every patch has a correlation surface over the map around its expected place. At the right place there is one motion
(translation, yaw, scale, tilt; the last three near their expected values) under which most patches have high values,
whether or not these are the maxima of their surfaces. Ground that has changed affects its own patches only, and
repetitive ground would have to repeat in all of them. The evidence is the sum of the patches' log likelihood ratios
under the best motion. This is a soft consensus with few unknowns, whereas RANSAC needs a third of the patches' maxima
to be right.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

# A patch's correlation in standard deviations of its own surface: N(UNCHANGED_Z, UNCHANGED_SIGMA) where the ground is
# the same, N(0, 1) elsewhere and where it has changed. UNCHANGED_SHARE: prior share of unchanged patches. [tuned]
UNCHANGED_Z, UNCHANGED_SIGMA, UNCHANGED_SHARE = 2.6, 0.9, 0.5
MAX_LLR = 3.5  # upper bound of one patch's evidence, nats [tuned]
# effective share of independent patches: neighbours overlap by half of their sides [tuned]
INDEPENDENT_PATCH_SHARE = 0.25
YAW_RANGE_RAD, YAW_STEPS = np.radians(8.0), 7  # half range of the yaw grid, and its number of values [tuned]
SCALE_RANGE, SCALE_STEPS = 0.08, 7  # half range of the scale grid, relative, and its number of values [tuned]
# 1-sigma of the yaw and scale error that a hypothesis of the search leaves [tuned]
YAW_SIGMA_RAD, PATCH_SCALE_SIGMA = np.radians(5.0), 0.05
PATCH_SPREAD = 0.02  # share of the height, 1-sigma of a patch's displacement by relief and leaning buildings [tuned]
CHANCE_SIGMAS = 3.0 * 2.0**0.5  # of the difference of two sums [spec: 99.7 %]
SIGMA_OF_MAD = 1.4826  # of a normal distribution [spec: Rousseeuw and Croux 1993]
# log weight of a cell by its standardised correlation [spec: a tenth of a sigma below the peak counts half]
PEAK_SHARPNESS = 6.0
# shares of the height: search radius of the patches in successive Gauss-Newton iterations [tuned]
SEARCH_RADII = (0.05, 0.04, 0.03, 0.03)


@dataclass(frozen=True)
class PatchConsensus:
    """``llr``: evidence in nats before the null model is subtracted. ``motion`` (6,): east, north, yaw, scale, tilt
    about north and east; small angles, lengths in heights. ``offsets`` (N, 2): displacement of each patch from its
    expected place, east and north in heights; ``values`` (N,): its evidence in nats. ``open_cov`` (2, 2): of the common
    translation along the direction that the surfaces leave open, east and north in heights; none where there is a
    peak, as wide as a height squared along an edge (aperture problem)."""

    llr: float
    motion: np.ndarray
    offsets: np.ndarray
    values: np.ndarray
    open_cov: np.ndarray

    @property
    def inliers(self) -> np.ndarray:
        """(N,) bool: patches with evidence for the place."""
        return np.asarray(self.values > 0.0)


def estimate_consensus(surfaces: np.ndarray, ground: np.ndarray, cell: float, tilt_sigma_rad: float) -> PatchConsensus:
    """``surfaces`` (N, 2R + 1, 2R + 1): correlation around the expected place, rows southwards, columns eastwards;
    ``ground`` (N, 2): centre of each patch, east and north of the nadir, and ``cell``, both in heights."""
    mean, spread = surfaces.mean(axis=(1, 2), keepdims=True), surfaces.std(axis=(1, 2), keepdims=True)
    z = ((surfaces - mean) / np.maximum(spread, 1e-6)).astype(np.float32)
    llr = _log_likelihood_ratio(z)
    jacobian = _jacobian(ground)
    motion = _grid_search(llr, jacobian, cell)
    sigma = np.array([np.inf, np.inf, YAW_SIGMA_RAD, PATCH_SCALE_SIGMA, tilt_sigma_rad, tilt_sigma_rad])
    information = INDEPENDENT_PATCH_SHARE / PATCH_SPREAD**2
    for radius in SEARCH_RADII:
        offsets, value = _best_offsets(z, llr, jacobian @ motion, cell, radius)
        weighted = jacobian * (information * np.maximum(value, 0.0) / MAX_LLR)[:, None, None]
        hessian = np.einsum("nki,nkj->ij", weighted, jacobian) + np.diag(1.0 / sigma**2 + 1e-6)
        motion = np.linalg.solve(hessian, np.einsum("nki,nk->i", weighted, offsets))
    offsets, value = _best_offsets(z, llr, jacobian @ motion, cell, PATCH_SPREAD)
    prior = 0.5 * float(((motion / sigma) ** 2).sum())
    open_cov = _open_cov(llr, jacobian @ motion, cell)
    return PatchConsensus(INDEPENDENT_PATCH_SHARE * float(value.sum()) - prior, motion, offsets, value, open_cov)


def _open_cov(llr: np.ndarray, expected: np.ndarray, cell: float) -> np.ndarray:
    """(2, 2) of ``PatchConsensus.open_cov``: the posterior of a common translation added to the ``expected`` offsets
    (N, 2), less the information of the window that it is computed in, and less what both directions share. Places whose
    evidence differs by no more than chance does (along an edge the highest one is any) are equally probable."""
    side = llr.shape[1]
    columns, rows = np.rint(expected / cell).astype(int).T * [[1], [-1]]
    k = side // 2 - int(max(np.abs(columns).max(), np.abs(rows).max()))
    if k < 1:
        return np.zeros((2, 2))
    total = np.zeros((2 * k + 1, 2 * k + 1))
    for surface, row, column in zip(llr, rows + side // 2, columns + side // 2, strict=True):
        total += surface[row - k : row + k + 1, column - k : column + k + 1]
    chance = CHANCE_SIGMAS * SIGMA_OF_MAD * float(np.median(np.abs(total - np.median(total))))
    mass = np.exp(-INDEPENDENT_PATCH_SHARE * np.maximum(total.max() - total - chance, 0.0))
    north, east = np.meshgrid(np.arange(k, -k - 1, -1), np.arange(-k, k + 1), indexing="ij")
    cov = np.cov(np.stack([east.ravel(), north.ravel()]), aweights=mass.ravel(), ddof=0) * cell**2
    window = np.arange(-k, k + 1).var() * cell**2
    variance, axes = np.linalg.eigh(cov + 1e-12 * np.eye(2))
    variance = 1.0 / np.maximum(1.0 / variance - 1.0 / window, 1.0)
    return np.asarray(axes @ np.diag(variance - variance.min()) @ axes.T)


def _log_likelihood_ratio(z: np.ndarray) -> np.ndarray:
    """Log likelihood ratio of standardised correlations, "under the right motion against anywhere"."""
    log_ratio = 0.5 * z**2 - 0.5 * (np.minimum(z - UNCHANGED_Z, 0.0) / UNCHANGED_SIGMA) ** 2 - np.log(UNCHANGED_SIGMA)
    same = UNCHANGED_SHARE * np.exp(np.minimum(log_ratio, 2.0 * MAX_LLR))
    return np.asarray(np.minimum(np.log(same + 1.0 - UNCHANGED_SHARE), MAX_LLR), np.float32)


def _jacobian(ground: np.ndarray) -> np.ndarray:
    """(N, 2, 6): derivative of a patch's place by translation (2), yaw, scale and tilt (2); in heights, small
    angles."""
    x, y = ground.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    east = np.stack([one, zero, -y, x, 1.0 + x * x, x * y], axis=1)
    north = np.stack([zero, one, x, y, x * y, 1.0 + y * y], axis=1)
    return np.stack([east, north], axis=1)


def _grid_search(llr: np.ndarray, jacobian: np.ndarray, cell: float) -> np.ndarray:
    """(6,): best motion on a grid of yaws and scales and over all translations, from the sum of the shifted
    surfaces."""
    side = llr.shape[1]
    # tolerance of half a grid step
    near = np.stack([cv2.dilate(surface, np.ones((3, 3), np.uint8)) for surface in llr])
    yaws, scales = (
        np.linspace(-YAW_RANGE_RAD, YAW_RANGE_RAD, YAW_STEPS),
        np.linspace(-SCALE_RANGE, SCALE_RANGE, SCALE_STEPS),
    )
    grid = [np.array([0.0, 0.0, yaw, scale, 0.0, 0.0]) for yaw in yaws for scale in scales]
    shifts = [np.rint(jacobian @ motion / cell).astype(int) for motion in grid]
    pad = max(int(np.abs(shift).max()) for shift in shifts)
    padded = np.pad(near, ((0, 0), (pad, pad), (pad, pad)))  # zero evidence outside of the searched area
    shifted = sliding_window_view(padded, (side, side), axis=(1, 2))
    best, best_motion = -np.inf, grid[0]
    for motion, shift in zip(grid, shifts, strict=True):
        total = shifted[np.arange(len(llr)), pad - shift[:, 1], pad + shift[:, 0]].sum(axis=0)
        prior = 0.5 * ((motion[2] / YAW_SIGMA_RAD) ** 2 + (motion[3] / PATCH_SCALE_SIGMA) ** 2)
        r, c = np.unravel_index(int(np.argmax(total)), total.shape)
        value = INDEPENDENT_PATCH_SHARE * float(total[r, c]) - prior
        if value > best:
            best, best_motion = value, motion
            best_motion[:2] = (c - side // 2) * cell, (side // 2 - r) * cell
    return best_motion


def _best_offsets(
    z: np.ndarray, llr: np.ndarray, expected: np.ndarray, cell: float, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """Place of each patch within ``radius`` of its ``expected`` offset (N, 2), as an offset, and its best evidence
    (N,); 0 outside of the surface. The place is the mean of the cells, weighted by ``z``, and by less towards the
    border of the search: of two cells that are almost equally high neither wins by its last bit. By ``z``, because
    around a clear peak several cells reach the bound of ``llr``."""
    side = llr.shape[1]
    k = max(round(radius / cell), 1)
    reach2 = (max(radius / cell, 1.0) + 1.0) ** 2  # a cell beyond, where the weight is zero
    row, column = side // 2 - expected[:, 1] / cell, side // 2 + expected[:, 0] / cell
    r, c = np.rint(row).astype(int), np.rint(column).astype(int)
    there = np.flatnonzero((r >= 0) & (r < side) & (c >= 0) & (c < side))
    outside = ((0, 0), (k, k), (k, k))
    near, near_llr = (
        sliding_window_view(np.pad(x, outside, constant_values=-np.inf), (2 * k + 1, 2 * k + 1), axis=(1, 2))[
            there, r[there], c[there]
        ].reshape(len(there), -1)
        for x in (z, llr)
    )
    offsets, value = expected.copy(), np.zeros(len(llr))
    best = np.arange(len(there)), near.argmax(axis=1)
    value[there] = near_llr[best]
    around = np.arange(-k, k + 1)
    dr, dc = ((r - row)[there, None] + around, (c - column)[there, None] + around)
    weight = np.exp(PEAK_SHARPNESS * (near - near[best][:, None])).reshape(-1, len(around), len(around))
    weight = weight * np.maximum(1.0 - (dr[:, :, None] ** 2 + dc[:, None] ** 2) / reach2, 0.0)
    total = weight.sum(axis=(1, 2))
    offsets[there, 0] += (weight.sum(axis=1) * dc).sum(axis=1) / total * cell
    offsets[there, 1] -= (weight.sum(axis=2) * dr).sum(axis=1) / total * cell
    return offsets, value
