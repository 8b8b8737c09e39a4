"""The last step of a map fix: the best places of a frame, matched again around the pose just found.

The first step (frame_matcher.py) searches each patch over a wide area. Once the pose is known, a place is off by a few
cells at most: larger patches with two channels instead of eight cost less than the first step. The precision of each
match follows from its own correlation peak, and the most precise ones are kept.
"""

from dataclasses import dataclass

import numpy as np

from terrafix.anchor.matching.descriptor_cache import CACHE_BYTES, MapFeatures, MapWindows
from terrafix.anchor.matching.descriptor_store import DescriptorStore
from terrafix.anchor.matching.orthorectify import Rectified, Relief, rectify
from terrafix.anchor.matching.patch_matcher import patch_means, patch_surfaces, usable_corners
from terrafix.core.camera import CameraCalibration
from terrafix.core.node import Image
from terrafix_engines.features.gradient import OrientationDescriber

# Shares of the height: cell of the fine step, side of its patches, and radius around the place that the pose gives.
# Larger patches are what makes it fine: on recorded flights cells down to the map's pixels change nothing, at twice to
# four times the cost. [measured: docs/acceptance.md]
FINE_GSD_PER_AGL, FINE_PATCH_PER_AGL, FINE_RADIUS = 1 / 200, 0.3, 0.03
# Places that are matched, and that are kept: by predicted precision the best fifth has a quarter of the error of the
# worst one. [measured: docs/acceptance.md]
MAX_PLACES, KEPT_PLACES = 20, 14
HARD_PLACES = 40  # that are matched where single coarse patches gave no pose [measured: docs/acceptance.md]
# Inlier threshold of fine matches, normalised image coordinates: three sigmas of the kept ones over relief and houses.
# [measured: docs/acceptance.md]
FINE_THRESHOLD = 0.01
# 1-sigma of a match, as ``_peak`` predicts it up to a factor, that has the weight 1, in heights. The best fifth has
# 0.03 to 0.08, so that weights and claims are those of the first step. [measured: docs/acceptance.md]
BEST_SIGMA = 0.01
MIN_CORRELATION = 0.1  # at which matches are as wrong as random ones [measured: docs/acceptance.md]
CACHE_SHARE = 4  # of the memory for coarse descriptors: those have four times as many channels [spec: 2 of 8 channels]


@dataclass(frozen=True)
class FineMatches:
    """``frame_m`` (N, 3): ground points under the patch centres, east, north and up relative to the camera, as the pose
    sees them; ``map_m`` (N, 2): the matched points on the map, local east and north; ``weight`` (N,) in (0, 1]."""

    frame_m: np.ndarray
    map_m: np.ndarray
    weight: np.ndarray


class FineMatcher:
    """Matches places of a frame with one map layer. ``cache_bytes``: memory for the layer's coarse descriptors."""

    def __init__(
        self, source: MapWindows, cache_bytes: int = CACHE_BYTES, store: DescriptorStore | None = None
    ) -> None:
        self._describer = OrientationDescriber()
        self._features = MapFeatures(source, self._describer, cache_bytes // CACHE_SHARE, store=store)

    def match(
        self,
        image: Image,
        camera: CameraCalibration,
        r_w_c: np.ndarray,
        place_m: tuple[float, float, float],
        cell_m: float,
        relief: Relief | None,
        max_places: int = MAX_PLACES,
    ) -> FineMatches | None:
        """``image`` (H, W) grey; ``r_w_c``: rotation of the camera; ``place_m``: its east and north, and its height
        above the plane of ``relief``; ``max_places``: number of places that are matched. None: no ground is visible, or
        too few places are on the map."""
        e_m, n_m, agl_m = place_m
        frame = rectify(image, camera, r_w_c, agl_m, cell_m, relief=relief)
        if frame is None:
            return None
        patch, radius = round(FINE_PATCH_PER_AGL * agl_m / cell_m), max(round(FINE_RADIUS * agl_m / cell_m), 3)
        margin, (h, w) = radius + 2, frame.mask.shape
        window, valid, e_min_m, n_max_m = self._features.window(
            e_m + frame.e_min_m - margin * cell_m,
            n_m + frame.n_max_m + margin * cell_m,
            w + 2 * margin,
            h + 2 * margin,
            cell_m,
        )
        row0 = round((n_max_m - (n_m + frame.n_max_m)) / cell_m)
        column0 = round((e_m + frame.e_min_m - e_min_m) / cell_m)
        template = self._describer.describe(frame.image)
        corners = usable_corners(frame.mask, valid, patch, radius, row0, column0)
        if len(corners) < KEPT_PLACES:
            return None
        corners = corners[np.argsort(-_isotropy(template, patch, corners), kind="stable")[:max_places]]
        pairs = [(int(r), int(c)) for r, c in corners]
        surfaces = patch_surfaces(template, window, pairs, patch, radius, row0, column0)
        centres = corners + 0.5 * patch
        found = [_peak(surface) for surface in surfaces]
        sharp = [i for i, peak in enumerate(found) if peak is not None]
        peaks = np.array([found[i] for i in sharp]).reshape(-1, 4)
        best = np.argsort(peaks[:, 3], kind="stable")[:KEPT_PLACES]
        peaks, centres = peaks[best], centres[sharp][best]
        frame_m = _places(frame, centres, agl_m, relief)
        offset = peaks[:, 1::-1] - radius  # east, south
        map_m = np.column_stack(
            [
                e_min_m + (column0 + centres[:, 1] + offset[:, 0]) * cell_m,
                n_max_m - (row0 + centres[:, 0] + offset[:, 1]) * cell_m,
            ]
        )
        sigma = peaks[:, 3] * cell_m / agl_m
        return FineMatches(frame_m, map_m, np.minimum(1.0, (BEST_SIGMA / sigma) ** 2))


def _places(frame: Rectified, centres: np.ndarray, agl_m: float, relief: Relief | None) -> np.ndarray:
    """(N, 3): ground at cells ``centres`` (N, 2: row, column), relative to the camera."""
    e_m, n_m = frame.e_min_m + centres[:, 1] * frame.gsd_m, frame.n_max_m - centres[:, 0] * frame.gsd_m
    up_m = np.zeros(len(centres)) if relief is None else relief(e_m, n_m)
    return np.column_stack([e_m, n_m, up_m - agl_m])


def _isotropy(template: np.ndarray, patch: int, corners: np.ndarray) -> np.ndarray:
    """(N,), for the patches at ``corners`` (N, 2): mean length of the doubled gradients less the length of their
    mean, which is the smaller eigenvalue of their structure tensor. Along a single edge it is zero, and a patch there
    fits everywhere."""
    length = np.hypot(template[0], template[1])
    east, north, along = patch_means([*template, length], patch, corners)
    return np.asarray(along - np.hypot(east, north))


_Y, _X = (axis.ravel() for axis in np.mgrid[-1:2, -1:2])  # places of 3 x 3 values [spec: their coordinates]
# quadratic through 3 x 3 values [spec: least squares]
_QUADRATIC = np.linalg.pinv(np.column_stack([np.ones(9), _X, _Y, _X**2 / 2, _X * _Y, _Y**2 / 2]))


def _peak(surface: np.ndarray) -> tuple[float, float, float, float] | None:
    """(row, column, correlation, 1-sigma in cells up to a factor) of the peak; None: at the border, weak, or no
    maximum.

    A displaced patch of N independent cells with correlation c has the error covariance (1 - c^2) / (c N) times the
    inverse of the surface's negative curvature (Cramer-Rao bound of a known signal in white noise); the 1-sigma is that
    of the worst direction for N = 1."""
    r, c = np.unravel_index(int(np.argmax(surface)), surface.shape)
    best = float(surface[r, c])
    if r in (0, surface.shape[0] - 1) or c in (0, surface.shape[1] - 1) or best < MIN_CORRELATION:
        return None
    _, by_x, by_y, xx, xy, yy = _QUADRATIC @ surface[r - 1 : r + 2, c - 1 : c + 2].ravel()
    det = xx * yy - xy * xy
    least = -0.5 * (xx + yy) - float(np.hypot(0.5 * (xx - yy), xy))  # smaller eigenvalue of the negative curvature
    if least <= 1e-6:
        return None
    dx, dy = (xy * by_y - yy * by_x) / det, (xy * by_x - xx * by_y) / det
    sigma = float(np.sqrt((1.0 - min(best, 0.99) ** 2) / (best * least)))
    return float(r) + float(np.clip(dy, -1.0, 1.0)), float(c) + float(np.clip(dx, -1.0, 1.0)), best, sigma
