"""Localisation rate of feature methods: an image of one date on a map of another date.

A patch is cut from the first image, rotated and scaled by a random amount that the methods do not know, and searched
in a window of the second image. Dense methods correlate over a few rotations and scales; sparse methods match
keypoints of the whole patch.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from terrafix.anchor.matching.descriptor_cache import Describer
from terrafix.anchor.matching.ncc import CorrelationWindow
from terrafix.core.errors import MapError
from terrafix_engines.features import open_describer, open_detector, open_matcher, open_pair_matcher
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_engines.features.keypoints import Detector, MutualNearestMatcher
from terrafix_engines.features.pairs import ImagePairMatcher, SparsePairMatcher
from terrafix_engines.features.xfeat import XFeatDescriber
from terrafix_engines.store import StoredModel
from terrafix_tools.mapping.source import ImagerySource

PATCH_PX, WINDOW_PX = 400, 700
MAX_ROTATION_DEG, MAX_SCALE_ERROR, MAX_SHIFT_PX = 5.0, 0.05, 120  # unknown pose of the patch, uniform to either side
# Search steps of the dense methods in two rounds: 1.7 degrees and 1.7 % remain, then a third of that. With the larger
# remainder an image fits its leaning roofs as well as the ground.
STEPS, ROTATION_STEP_DEG, SCALE_STEP = (-1, 0, 1), (3.3, 1.1), (0.033, 0.011)
SEARCH_RADIUS_PX = 20  # search radius of the second round
POINTS = 1024  # keypoints of each image
RANSAC_PX, MIN_INLIERS = 3.0, 8
NEAR_PX, FAR_PX = 5.0, 20.0
SEED = 5
MAX_EMPTY_SHARE = 0.02  # largest share of pixels without imagery

Find = Callable[
    [np.ndarray, np.ndarray], tuple[float, float] | None
]  # (patch, window) -> centre of the patch in the window, px


def measure_pair(models: list[StoredModel], first: Path, second: Path, trials: int) -> dict[str, Any]:
    """Returns method -> shares, errors, times. Raises MapError, ModelFileError, ModelRunError."""
    camera, ground = same_grid(first, second)
    methods = _methods(models)
    results: dict[str, dict[str, list[float]]] = {name: {"error_px": [], "cpu_ms": []} for name in methods}
    rng = np.random.default_rng(SEED)
    for _ in track(range(trials), "places", console=Console(stderr=True), transient=True):
        patch, window, true_px = _random_trial(camera, ground, rng)
        for name, find in methods.items():
            cpu_s = time.process_time()
            found = find(patch, window)
            results[name]["cpu_ms"].append((time.process_time() - cpu_s) * 1e3)
            error_px = np.inf if found is None else float(np.hypot(found[0] - true_px[0], found[1] - true_px[1]))
            results[name]["error_px"].append(error_px)
    return {
        "first": str(first),
        "second": str(second),
        "trials": trials,
        "methods": {name: _summary(**one) for name, one in results.items()},
    }


def show_pair(result: dict[str, Any]) -> None:
    names = f"{Path(result['first']).name} on {Path(result['second']).name}"
    table = Table(title=f"{names}, {result['trials']} places", title_justify="left")
    for title in ("method", f"<= {NEAR_PX:g} px", f"<= {FAR_PX:g} px", "none", "median", "cpu"):
        table.add_column(title, justify="left" if title == "method" else "right", no_wrap=True)
    for name, one in result["methods"].items():
        error = "-" if one["median_px"] is None else f"{one['median_px']:.1f} px"
        shares = (f"{100 * one[key]:.0f} %" for key in ("near", "far", "no_answer"))
        table.add_row(name, *shares, error, f"{one['cpu_ms']:.0f} ms")
    Console().print(table)


def _methods(models: list[StoredModel]) -> dict[str, Find]:
    """Returns the methods without weights, and those of every given model."""
    methods: dict[str, Find] = {"SIFT": _sift, "gradients, dense": dense(GradientDescriber())}
    detectors: dict[str, Detector] = {}
    for model in models:
        m = model.manifest
        if m.role == "dense":
            describer = open_describer(m.name, str(model.path.parent))
            assert isinstance(describer, XFeatDescriber)
            methods[f"{m.name}, dense"] = dense(describer)
        if m.role in ("dense", "keypoints"):
            detectors[m.name] = open_detector(model)
            methods[f"{m.name}, nearest"] = sparse(SparsePairMatcher(detectors[m.name], MutualNearestMatcher(), POINTS))
    for model in models:
        if (spec := model.manifest.matcher) and spec.features in detectors:
            matched = SparsePairMatcher(detectors[spec.features], open_matcher(model), POINTS)
            methods[matched.name] = sparse(matched)
        if model.manifest.role == "pair":
            methods[model.manifest.name] = sparse(open_pair_matcher(model))
    return methods


@dataclass(frozen=True)
class Fit:
    """Position of the patch's corner in the window, cells, with its rotation and scale."""

    correlation: float
    column: float
    row: float
    rotation_deg: float
    scale: float


def dense(describer: Describer) -> Find:
    """Correlation as in the map matcher, over a grid of rotations and scales, then a finer one around the best."""
    stride = describer.stride
    side, cells, reach = WINDOW_PX // stride, PATCH_PX // stride, -(-SEARCH_RADIUS_PX // stride)
    centre = (PATCH_PX - 1) / 2

    def best(patch: np.ndarray, window: np.ndarray, centre_fit: Fit, round_: int) -> Fit:
        correlation_window = CorrelationWindow(window, np.ones(window.shape[1:], bool))
        fits = []
        for rotation_step, scale_step in itertools.product(STEPS, STEPS):
            rotation_deg = centre_fit.rotation_deg + rotation_step * ROTATION_STEP_DEG[round_]
            scale = centre_fit.scale + scale_step * SCALE_STEP[round_]
            matrix = cv2.getRotationMatrix2D((centre, centre), rotation_deg, scale)
            rotated = cv2.warpAffine(patch, matrix, (PATCH_PX, PATCH_PX))
            covered = cv2.warpAffine(np.full(patch.shape[:2], 255, np.uint8), matrix, (PATCH_PX, PATCH_PX)) == 255
            mask = np.asarray(covered.reshape(cells, stride, cells, stride).all(axis=(1, 3)))
            surface = correlation_window.correlate(describer.describe(rotated), mask)
            r, c = (int(v) for v in np.unravel_index(int(np.nanargmax(surface)), surface.shape))
            at = c + _vertex(surface[r], c), r + _vertex(surface[:, c], r)
            fits.append(Fit(float(surface[r, c]), *at, rotation_deg, scale))
        return max(fits, key=lambda fit: fit.correlation)

    def find(patch: np.ndarray, window: np.ndarray) -> tuple[float, float] | None:
        described = describer.describe(window[: side * stride, : side * stride])
        first = best(patch, described, Fit(0.0, 0.0, 0.0, 0.0, 1.0), 0)
        c0, r0 = (max(round(v) - reach, 0) for v in (first.column, first.row))
        neighbourhood = described[:, r0 : r0 + cells + 2 * reach, c0 : c0 + cells + 2 * reach]
        second = best(patch, neighbourhood, first, 1)
        return (second.column + c0) * stride + centre, (second.row + r0) * stride + centre

    return find


def sparse(matcher: ImagePairMatcher) -> Find:
    """Fits a similarity by RANSAC to the keypoint matches."""

    def find(patch: np.ndarray, window: np.ndarray) -> tuple[float, float] | None:
        pairs = matcher.match(patch, window)
        return _ransac_centre(pairs.first_px, pairs.second_px)

    return find


def _sift(patch: np.ndarray, window: np.ndarray) -> tuple[float, float] | None:
    sift = cv2.SIFT.create(2 * POINTS)
    (k0, d0), (k1, d1) = (sift.detectAndCompute(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY), None) for p in (patch, window))
    if d0 is None or d1 is None or len(d1) < 2:
        return None
    ratio_matches = [m for m, n in cv2.BFMatcher().knnMatch(d0, d1, k=2) if m.distance < 0.8 * n.distance]
    first, second = [k0[m.queryIdx].pt for m in ratio_matches], [k1[m.trainIdx].pt for m in ratio_matches]
    return _ransac_centre(np.array(first, np.float32).reshape(-1, 2), np.array(second, np.float32).reshape(-1, 2))


def _ransac_centre(first: np.ndarray, second: np.ndarray) -> tuple[float, float] | None:
    if len(first) < MIN_INLIERS:
        return None
    cv2.setRNGSeed(SEED)
    matrix, inliers = cv2.estimateAffinePartial2D(first, second, method=cv2.RANSAC, ransacReprojThreshold=RANSAC_PX)
    if matrix is None or int(inliers.sum()) < MIN_INLIERS:
        return None
    centre = (PATCH_PX - 1) / 2
    x, y = matrix @ np.array([centre, centre, 1.0])
    return float(x), float(y)


def _vertex(line: np.ndarray, at: int) -> float:
    """Offset of the vertex of the parabola through a sample and its neighbours, in cells."""
    if not 0 < at < len(line) - 1:
        return 0.0
    before, here, after = (float(v) for v in line[at - 1 : at + 2])
    curvature = before - 2.0 * here + after
    return 0.5 * (before - after) / curvature if curvature < -1e-9 else 0.0


def _random_trial(
    camera: np.ndarray, ground: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a patch (PATCH_PX), a window (WINDOW_PX), and the true centre of the patch in the window, px."""
    height, width = ground.shape[:2]
    for _ in range(1000):
        corner = rng.integers(0, (width - WINDOW_PX + 1, height - WINDOW_PX + 1))
        true_px = (WINDOW_PX - 1) / 2 + rng.uniform(-MAX_SHIFT_PX, MAX_SHIFT_PX, 2)
        rotation_deg, scale = (
            rng.uniform(-MAX_ROTATION_DEG, MAX_ROTATION_DEG),
            1.0 + rng.uniform(-MAX_SCALE_ERROR, MAX_SCALE_ERROR),
        )
        matrix = cv2.getRotationMatrix2D((0.0, 0.0), rotation_deg, scale)
        matrix[:, 2] = (PATCH_PX - 1) / 2 - matrix[:, :2] @ (corner + true_px)
        patch = cv2.warpAffine(camera, matrix, (PATCH_PX, PATCH_PX), flags=cv2.INTER_AREA)
        window = ground[corner[1] : corner[1] + WINDOW_PX, corner[0] : corner[0] + WINDOW_PX]
        if max(np.mean(part.max(axis=2) == 0) for part in (patch, window)) <= MAX_EMPTY_SHARE:
            return patch, window, true_px
    raise MapError("the two images have no common area that is large enough; choose another --pair")


def same_grid(first: Path, second: Path) -> tuple[np.ndarray, np.ndarray]:
    """Returns both images on the grid of the second one, (H, W, 3) uint8 BGR."""
    with ImagerySource(first) as one, ImagerySource(second) as two:
        if one.crs != two.crs:
            raise MapError(f"{first}: another coordinate system than {second}; bring it into that one with gdalwarp")
        if min(two.width_px, two.height_px) < WINDOW_PX:
            raise MapError(f"{second}: {two.width_px} x {two.height_px} px, less than the {WINDOW_PX} px of a window")
        camera, ground = (image.read(0, 0, image.width_px, image.height_px)[0] for image in (one, two))
        wider, higher = one.pixel_x / two.pixel_x, one.pixel_y / two.pixel_y
        east_px, south_px = (one.x_min - two.x_min) / two.pixel_x, (two.y_max - one.y_max) / two.pixel_y
        # The geotransform refers to pixel corners; OpenCV's coordinates to pixel centres.
        matrix = np.array([[wider, 0, east_px + 0.5 * wider - 0.5], [0, higher, south_px + 0.5 * higher - 0.5]])
    return cv2.warpAffine(camera, matrix, (ground.shape[1], ground.shape[0]), flags=cv2.INTER_LINEAR), ground


def _summary(error_px: list[float], cpu_ms: list[float]) -> dict[str, Any]:
    errors = np.array(error_px)
    answered = errors[np.isfinite(errors)]
    return {
        "near": float(np.mean(errors <= NEAR_PX)),
        "far": float(np.mean(errors <= FAR_PX)),
        "no_answer": float(np.mean(~np.isfinite(errors))),
        "median_px": float(np.median(answered)) if len(answered) else None,
        "cpu_ms": float(np.median(cpu_ms)),
    }
