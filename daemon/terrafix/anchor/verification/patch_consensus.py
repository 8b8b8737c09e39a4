"""What one frame says for a place: how well its patches agree with the map under one motion of the camera.

Every patch of the frame has a correlation surface over the map around its expected place. At the right place there is
one motion (translation, heading, scale, tilt; the last three near what is expected) under which most patches find good
values, be they the best of their surfaces or not. Ground that has changed takes its own patches away and no more; a
repeat of the ground would have to repeat in all of them. The evidence is the sum of the patches' log likelihood ratios
under the best motion: a soft consensus with few unknowns, where a pose by RANSAC needs a third of the patches' best
values to be right."""

from dataclasses import dataclass

import cv2
import numpy as np

# A patch's correlation in standard deviations of its own surface: N(SAME_Z, SAME_SIGMA) where the ground is the same,
# N(0, 1) anywhere else and where it has changed, which is taken for every other patch.
SAME_Z, SAME_SIGMA, SAME_SHARE = 2.6, 0.9, 0.5
MOST_LLR = 3.5  # of one patch
INDEPENDENT = 0.25  # share of the patches: neighbours overlap by half of their sides
YAW_RAD, YAW_STEPS = np.radians(8.0), 7  # half the range that is tried, and in how many steps
SCALE, SCALE_STEPS = 0.08, 7
YAW_SIGMA_RAD, SCALE_SIGMA = np.radians(5.0), 0.05  # of what the hypothesis of a search leaves open
SPREAD = 0.02  # of the height: relief and leaning buildings take a patch aside by about this
NARROWING = (0.05, 0.04, 0.03, 0.03)  # of the height: reach of the patches as the motion becomes known


@dataclass(frozen=True)
class PatchConsensus:
    """``llr``: evidence in nats, not yet against what chance comes to. ``motion`` (6,): east, north, heading, scale and
    tilt about north and east, small angles, lengths in heights. ``offsets`` (N, 2): where each patch lies against its
    expected place, east and north in heights; ``agrees`` (N,) bool."""

    llr: float
    motion: np.ndarray
    offsets: np.ndarray
    agrees: np.ndarray


def agreement(surfaces: np.ndarray, ground: np.ndarray, cell: float, tilt_sigma_rad: float) -> PatchConsensus:
    """``surfaces`` (N, 2R + 1, 2R + 1): correlation, rows southwards and columns eastwards around the expected place;
    ``ground`` (N, 2): middle of each patch, east and north of the nadir, and ``cell``, both in heights."""
    mean, spread = surfaces.mean(axis=(1, 2), keepdims=True), surfaces.std(axis=(1, 2), keepdims=True)
    z = ((surfaces - mean) / np.maximum(spread, 1e-6)).astype(np.float32)
    llr = _log_likelihood_ratio(z)
    jacobian = _jacobian(ground)
    motion = _best_of_grid(llr, jacobian, cell)
    sigma = np.array([np.inf, np.inf, YAW_SIGMA_RAD, SCALE_SIGMA, tilt_sigma_rad, tilt_sigma_rad])
    information = INDEPENDENT / SPREAD**2
    for reach in NARROWING:
        offsets, value = _nearest(z, llr, jacobian @ motion, cell, reach)
        weighted = jacobian * (information * np.maximum(value, 0.0) / MOST_LLR)[:, None, None]
        hessian = np.einsum("nki,nkj->ij", weighted, jacobian) + np.diag(1.0 / sigma**2 + 1e-6)
        motion = np.linalg.solve(hessian, np.einsum("nki,nk->i", weighted, offsets))
    offsets, value = _nearest(z, llr, jacobian @ motion, cell, SPREAD)
    prior = 0.5 * float(((motion / sigma) ** 2).sum())
    return PatchConsensus(INDEPENDENT * float(value.sum()) - prior, motion, offsets, value > 0.0)


def _log_likelihood_ratio(z: np.ndarray) -> np.ndarray:
    """Of standardised correlations, "under the right motion against anywhere"."""
    log_ratio = 0.5 * z**2 - 0.5 * (np.minimum(z - SAME_Z, 0.0) / SAME_SIGMA) ** 2 - np.log(SAME_SIGMA)
    same = SAME_SHARE * np.exp(np.minimum(log_ratio, 2.0 * MOST_LLR))
    return np.asarray(np.minimum(np.log(same + 1.0 - SAME_SHARE), MOST_LLR), np.float32)


def _jacobian(ground: np.ndarray) -> np.ndarray:
    """(N, 2, 6): how a patch moves by translation (2), heading, scale and tilt (2), all in heights, small angles."""
    x, y = ground.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    east = np.stack([one, zero, -y, x, 1.0 + x * x, x * y], axis=1)
    north = np.stack([zero, one, x, y, x * y, 1.0 + y * y], axis=1)
    return np.stack([east, north], axis=1)


def _best_of_grid(llr: np.ndarray, jacobian: np.ndarray, cell: float) -> np.ndarray:
    """(6,): best of a grid of headings and scales and of all translations, by adding up the surfaces as these shift
    them."""
    side = llr.shape[1]
    near = np.stack([cv2.dilate(surface, np.ones((3, 3), np.uint8)) for surface in llr])  # half a step of the grid
    yaws, scales = np.linspace(-YAW_RAD, YAW_RAD, YAW_STEPS), np.linspace(-SCALE, SCALE, SCALE_STEPS)
    grid = [np.array([0.0, 0.0, yaw, scale, 0.0, 0.0]) for yaw in yaws for scale in scales]
    shifts = [np.rint(jacobian @ motion / cell).astype(int) for motion in grid]
    pad = max(int(np.abs(shift).max()) for shift in shifts)
    padded = np.pad(near, ((0, 0), (pad, pad), (pad, pad)))  # what was not searched says nothing
    best, best_motion = -np.inf, grid[0]
    for motion, shift in zip(grid, shifts, strict=True):
        total = np.zeros((side, side), np.float32)
        for surface, (east, north) in zip(padded, shift, strict=True):
            total += surface[pad - north : pad - north + side, pad + east : pad + east + side]
        prior = 0.5 * ((motion[2] / YAW_SIGMA_RAD) ** 2 + (motion[3] / SCALE_SIGMA) ** 2)
        r, c = np.unravel_index(int(np.argmax(total)), total.shape)
        value = INDEPENDENT * float(total[r, c]) - prior
        if value > best:
            best, best_motion = value, motion
            best_motion[:2] = (c - side // 2) * cell, (side // 2 - r) * cell
    return best_motion


def _nearest(
    z: np.ndarray, llr: np.ndarray, expected: np.ndarray, cell: float, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """The best place of each patch within ``reach`` of its ``expected`` offset (N, 2), and what it is worth (N,); 0
    beyond the surface. Best by ``z``: around a clear peak several cells are worth the most that a patch can be, and the
    first of them lies north-west of it."""
    side = llr.shape[1]
    k = max(round(reach / cell), 1)
    offsets, value = expected.copy(), np.zeros(len(llr))
    for i, (surface, (e, n)) in enumerate(zip(z, expected, strict=True)):
        r, c = round(side // 2 - n / cell), round(side // 2 + e / cell)
        if 0 <= r < side and 0 <= c < side:
            top, left = max(r - k, 0), max(c - k, 0)
            near = surface[top : r + k + 1, left : c + k + 1]
            dr, dc = np.unravel_index(int(np.argmax(near)), near.shape)
            value[i] = llr[i, top + int(dr), left + int(dc)]
            offsets[i] = (left + int(dc) - side // 2) * cell, (side // 2 - top - int(dr)) * cell
    return offsets, value
