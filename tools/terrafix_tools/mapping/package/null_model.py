"""Fits the null model of a map: scores of the best wrong places, from flights that cannot be on the map.

The flights are over mirrored and rotated parts of the same map: ground of the same type and scale that does not occur
on the map. They are processed by the search that is used in flight."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np

from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.hypothesis_tracker import NEW_EVIDENCE
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import UsageError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.format import Layer
from terrafix.map.null_model import DEFAULT_NULL, SCORE_VERSION, FalseAlarmBudget, NullModel, NullRow, Tail
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.mapping.check.sight import NORTH_UP
from terrafix_tools.mapping.package.rewrite import rewrite_manifest

CAMERA = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
# 1-sigma errors of a predicted view in a flight with a compass.
YAW_SIGMA_RAD, SCALE_SIGMA, TILT_SIGMA_RAD = math.radians(11.0), 0.06, math.radians(1.2)
STEP_SIGMA = 0.01  # 1-sigma of an odometry step, fraction of the height
STEPS_PER_STRETCH = 2
FLIGHTS, STRETCHES = 10, 6  # about two minutes of one core per height
DRAWS = 40  # attempts to find the ground of one flight
VALID = 0.98  # minimum fraction of valid ground of a flight
SEED = 1  # fixed, so that the model is deterministic


@dataclass(frozen=True)
class Strip:
    """Ground along a straight path, (h, w, 3); the camera moves from its left end to its right end."""

    picture: Image
    step_px: float

    def frame(self, i: int) -> Image:
        left = round(i * self.step_px)
        return np.ascontiguousarray(self.picture[:, left : left + CAMERA.width])


def add_null_models(package: Path, heights_m: Sequence[float]) -> None:
    """Adds the null model of the newest layer to a package; it must be unsigned.

    Raises UsageError: the map is too small for flights at one of these heights."""
    opened = MapPackage.open(package)
    try:
        west, south, east, north = opened.manifest.bounds_wgs84
        local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
        rows = tuple(fit_null_row(local, agl_m, FLIGHTS, STRETCHES) for agl_m in heights_m)
        model = NullModel(version=SCORE_VERSION, matcher=GradientDescriber.name, rows=rows)
        newest, *others = opened.manifest.layers
        layers: tuple[Layer, ...] = (msgspec.structs.replace(newest, null_model=model), *others)
        manifest = msgspec.structs.replace(opened.manifest, layers=layers)
    finally:
        opened.close()
    rewrite_manifest(package, manifest)


def fit_null_row(source: LocalMap, agl_m: float, flights: int, stretches: int) -> NullRow:
    """Null model row from ``flights`` over mirrored ground with ``stretches`` of new ground each. Raises UsageError."""
    draw = np.random.default_rng(SEED)
    best, sigmas, patches, places = list[float](), list[float](), list[tuple[float, float]](), 1.0
    for _ in range(flights):
        strip = _strip(source, agl_m, stretches, draw)
        search = MapSearch(
            source, FrameMatcher(CAMERA, source, GradientDescriber()), agl_m, None, DEFAULT_NULL, FalseAlarmBudget()
        )
        for stretch in range(stretches):
            reached = -math.inf
            for step in range(STEPS_PER_STRETCH):
                search.process_frame(strip.frame(stretch * STEPS_PER_STRETCH + step), _predicted_view(agl_m))
                reached = max([reached, *(track.log_odds for track in search.tracker.tracks)])
                sigmas += search.tracker.sigmas
                search.predict(NEW_EVIDENCE / STEPS_PER_STRETCH * agl_m, 0.0, STEP_SIGMA * agl_m)
            if stretch and math.isfinite(reached):  # the first stretch has too few frames for a hypothesis
                best.append(reached)
        patches.append(search.tracker.null.patches)
        places = search.candidate_count
    mean, sigma = np.mean(patches, axis=0)
    return NullRow(
        agl_m=agl_m,
        places=round(places, 1),
        search=Tail.fit(best, DEFAULT_NULL.search),
        frame=Tail.fit(sigmas, DEFAULT_NULL.frame),
        patches=(round(float(mean), 4), round(float(sigma), 4)),
    )


def _predicted_view(agl_m: float) -> View:
    return View(0.0, 0.0, NORTH_UP, agl_m, 0.0, YAW_SIGMA_RAD, SCALE_SIGMA, TILT_SIGMA_RAD)


def _strip(source: LocalMap, agl_m: float, stretches: int, draw: np.random.Generator) -> Strip:
    """A strip of the map in a random direction, mirrored."""
    gsd_m = agl_m / CAMERA.fx
    step_px = NEW_EVIDENCE / STEPS_PER_STRETCH * agl_m / gsd_m
    width = CAMERA.width + math.ceil(stretches * STEPS_PER_STRETCH * step_px)
    side = math.ceil(math.hypot(width, CAMERA.height))
    e_min, n_min, e_max, n_max = source.bounds_m
    for _ in range(DRAWS):
        e_m, n_m = draw.uniform(e_min, e_max), draw.uniform(n_min, n_max)
        turn = cv2.getRotationMatrix2D((side / 2, side / 2), draw.uniform(0.0, 360.0), 1.0)
        turn[0, 2] += (width - side) / 2
        turn[1, 2] += (CAMERA.height - side) / 2
        half_m = side / 2 * gsd_m
        picture, valid = source.window(e_m - half_m, n_m + half_m, side, side, gsd_m)
        seen = cv2.warpAffine(valid.astype(np.uint8), turn, (width, CAMERA.height))
        if seen.mean() >= VALID:
            return Strip(cv2.warpAffine(picture, turn, (width, CAMERA.height))[:, ::-1], step_px)
    raise UsageError(
        f"no straight path of {stretches * NEW_EVIDENCE * agl_m:.0f} m at {agl_m:.0f} m above ground fits on the map; "
        "give --null-agl a lower height, or leave it out"
    )
