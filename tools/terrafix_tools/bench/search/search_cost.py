"""Cost of the relocalisation search: one decision over a whole map, one over 25 tiles, one sweep of headings.

python -m terrafix_tools.bench.search.search_cost MAP.gpkg [--agl 120] [--json FILE]

The images are parts of the map itself, along a straight path: this measures time, not recall. Every line begins with a
new reader of the package: *first* includes the reading and description of the tiles, *next* is the slowest of the
later decisions. Wall-clock seconds, and processor seconds of all threads."""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import typer

from terrafix.anchor.matching.frame_matcher import FrameMatcher, Hypothesis, View
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, BlockCorrelator, blocks_of
from terrafix.anchor.relocalization.map_search import FINE_CELL_PER_AGL, MapSearch
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.null_model import DEFAULT_NULL, FalseAlarmBudget
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber

CAMERA = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
NORTH_UP = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
COMPASS_RAD, UNKNOWN_RAD = math.radians(11.0), math.radians(180.0)  # 1-sigma of a heading
SCALE_SIGMA, TILT_SIGMA_RAD = 0.06, math.radians(1.2)
STEP = 0.2  # motion between two decisions, in heights; each decision correlates the whole region
DECISIONS = 4
TILES, SWEEP_TILES, SWEEP_HEADINGS = 25, 1, 12


@dataclass(frozen=True)
class Cost:
    """``first_*``: of the first decision; ``next_*``: of the slowest later one."""

    what: str
    first_s: float
    first_cpu_s: float
    next_s: float
    next_cpu_s: float


def measure(package: Path, agl_m: float) -> list[Cost]:
    """-> one row per kind of search. Raises MapError."""

    def fresh() -> tuple[LocalMap, FrameMatcher]:
        opened = MapPackage.open(package)
        west, south, east, north = opened.manifest.bounds_wgs84
        local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
        return local, FrameMatcher(CAMERA, local, GradientDescriber())

    imagery, _ = fresh()
    frames = [_frame(imagery, k * STEP * agl_m, agl_m) for k in range(DECISIONS)]
    return [
        _cost("whole map, heading by compass", _decisions(*fresh(), frames, agl_m, COMPASS_RAD)),
        _cost("whole map, heading unknown", _decisions(*fresh(), frames, agl_m, UNKNOWN_RAD)),
        _cost(f"{TILES} tiles, heading by compass", _correlations(*fresh(), frames, agl_m, TILES, None)),
        _cost(
            f"sweep of {SWEEP_HEADINGS} headings, {SWEEP_TILES} tile",
            _correlations(*fresh(), frames, agl_m, SWEEP_TILES, SWEEP_HEADINGS),
        ),
    ]


def _view(agl_m: float, yaw_sigma_rad: float) -> View:
    return View(0.0, 0.0, NORTH_UP, agl_m, 0.0, yaw_sigma_rad, SCALE_SIGMA, TILT_SIGMA_RAD)


def _frame(source: LocalMap, east_m: float, agl_m: float) -> Image:
    """-> image of CAMERA that looks straight down, ``east_m`` from the centre, north up."""
    gsd_m, (w, h) = agl_m / CAMERA.fx, (CAMERA.width, CAMERA.height)
    return source.window(east_m - w / 2 * gsd_m, h / 2 * gsd_m, w, h, gsd_m)[0]


def _decisions(
    source: LocalMap, matcher: FrameMatcher, frames: list[Image], agl_m: float, yaw_sigma_rad: float
) -> list[Callable[[], object]]:
    """-> for each frame the joint correlation over the whole map with the update of the hypotheses."""
    search, view = (
        MapSearch(source, matcher, agl_m, None, DEFAULT_NULL, FalseAlarmBudget()),
        _view(agl_m, yaw_sigma_rad),
    )

    def decide(frame: Image) -> None:
        search.process_frame(frame, view)
        search.predict(STEP * agl_m, 0.0, 0.01 * agl_m)

    return [lambda frame=frame: decide(frame) for frame in frames]  # type: ignore[misc]


def _correlations(
    source: LocalMap, matcher: FrameMatcher, frames: list[Image], agl_m: float, tiles: int, headings: int | None
) -> list[Callable[[], object]]:
    """-> for each frame the correlation with the ``tiles`` around the centre on fine cells, as in a search around the
    last position. ``headings``: number of headings over the full circle; None: heading and scale hypotheses of the
    compass."""
    view, cell_m = _view(agl_m, COMPASS_RAD), matcher.cell_m(agl_m, FINE_CELL_PER_AGL)
    correlator, half = BlockCorrelator(source, GradientDescriber()), BLOCK_CELLS / 2
    blocks = sorted(blocks_of(source.bounds_m, cell_m), key=lambda b: math.hypot(b.row + half, b.column + half))
    sweep = [Hypothesis(2.0 * math.pi * k / headings, 1.0) for k in range(headings)] if headings else None

    def correlate(frame: Image) -> None:
        rectified = matcher.rectify_all(frame, view, sweep or matcher.map_search_hypotheses(view), cell_m, 1)
        described = [correlator.describe(one) for one in rectified if one is not None]
        correlator.correlate(described, blocks[:tiles], cell_m)

    return [lambda frame=frame: correlate(frame) for frame in frames]  # type: ignore[misc]


def _cost(what: str, works: list[Callable[[], object]]) -> Cost:
    seconds = []
    for work in works:
        began_s, began_cpu_s = time.monotonic(), time.process_time()
        work()
        seconds.append((time.monotonic() - began_s, time.process_time() - began_cpu_s))
    (first_s, first_cpu_s), (next_s, next_cpu_s) = seconds[0], max(seconds[1:])
    return Cost(what, round(first_s, 2), round(first_cpu_s, 2), round(next_s, 2), round(next_cpu_s, 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("package", type=Path, metavar="MAP.gpkg")
    parser.add_argument("--agl", type=float, default=120.0, help="height above ground, m")
    parser.add_argument("--json", type=Path, help="writes the table")
    given = parser.parse_args()
    try:
        costs = measure(given.package, given.agl)
    except TerrafixError as error:
        sys.exit(f"{error}")
    typer.echo(f"{'one decision':32} first: clock, CPU    next: clock, CPU")
    for c in costs:
        typer.echo(f"{c.what:32} {c.first_s:10.2f} s {c.first_cpu_s:5.2f} s {c.next_s:9.2f} s {c.next_cpu_s:5.2f} s")
    if given.json is not None:
        given.json.write_text(json.dumps([asdict(c) for c in costs], indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
