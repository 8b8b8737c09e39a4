"""What the search of an unknown place costs: one decision over a whole map, one over 25 tiles, one sweep of headings.

python -m terrafix_tools.bench.searching MAP.gpkg [--agl 120] [--json FILE]

The camera sees a piece of the map itself, from place to place along a way: this is about time, not about finding.
Every line begins with a fresh reader of the package: *first* includes what is read and described for the first time,
*next* is the slowest of those that follow. Seconds by the clock, and of the processor (all threads)."""

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
from terrafix.anchor.relocalization.block_search import BLOCK_CELLS, WideSearch, blocks_of
from terrafix.anchor.relocalization.map_search import FINE_CELL_PER_AGL, MapSearch
from terrafix.core.camera import CameraCalibration
from terrafix.core.errors import TerrafixError
from terrafix.core.geodesy import LocalFrame
from terrafix.core.node import Image
from terrafix.map.null_model import USUAL, FlightBudget
from terrafix.map.package import LocalMap, MapPackage
from terrafix_engines.features.gradient import GradientDescriber

CAMERA = CameraCalibration(640, 360, 380.0, 380.0, 319.5, 179.5)
NORTH_UP = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]])
COMPASS_RAD, UNKNOWN_RAD = math.radians(11.0), math.radians(180.0)  # 1-sigma of a heading
SCALE_SIGMA, TILT_SIGMA_RAD = 0.06, math.radians(1.2)
STEP = 0.2  # of the height, between decisions: each is a look at the whole region
DECISIONS = 4
TILES, SWEEP_TILES, SWEEP_HEADINGS = 25, 1, 12


@dataclass(frozen=True)
class Cost:
    what: str
    first_s: float
    first_cpu_s: float
    next_s: float
    next_cpu_s: float


def measure(package: Path, agl_m: float) -> list[Cost]:
    """Raises MapError."""

    def fresh() -> tuple[LocalMap, FrameMatcher]:
        opened = MapPackage.open(package)
        west, south, east, north = opened.manifest.bounds_wgs84
        local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
        return local, FrameMatcher(CAMERA, local, GradientDescriber())

    shown, _ = fresh()
    frames = [_frame(shown, k * STEP * agl_m, agl_m) for k in range(DECISIONS)]
    return [
        _cost("whole map, heading by compass", _decisions(*fresh(), frames, agl_m, COMPASS_RAD)),
        _cost("whole map, heading unknown", _decisions(*fresh(), frames, agl_m, UNKNOWN_RAD)),
        _cost(f"{TILES} tiles, heading by compass", _looks(*fresh(), frames, agl_m, TILES, None)),
        _cost(
            f"sweep of {SWEEP_HEADINGS} headings, {SWEEP_TILES} tile",
            _looks(*fresh(), frames, agl_m, SWEEP_TILES, SWEEP_HEADINGS),
        ),
    ]


def _view(agl_m: float, yaw_sigma_rad: float) -> View:
    return View(0.0, 0.0, NORTH_UP, agl_m, 0.0, yaw_sigma_rad, SCALE_SIGMA, TILT_SIGMA_RAD)


def _frame(source: LocalMap, east_m: float, agl_m: float) -> Image:
    """What CAMERA sees straight down, north up."""
    gsd_m, (w, h) = agl_m / CAMERA.fx, (CAMERA.width, CAMERA.height)
    return source.window(east_m - w / 2 * gsd_m, h / 2 * gsd_m, w, h, gsd_m)[0]


def _decisions(
    source: LocalMap, matcher: FrameMatcher, frames: list[Image], agl_m: float, yaw_sigma_rad: float
) -> list[Callable[[], object]]:
    """Joint look and tracks of each frame."""
    search, view = MapSearch(source, matcher, agl_m, None, USUAL, FlightBudget()), _view(agl_m, yaw_sigma_rad)

    def decide(frame: Image) -> None:
        search.look(frame, view)
        search.move(STEP * agl_m, 0.0, 0.01 * agl_m)

    return [lambda frame=frame: decide(frame) for frame in frames]  # type: ignore[misc]


def _looks(
    source: LocalMap, matcher: FrameMatcher, frames: list[Image], agl_m: float, tiles: int, headings: int | None
) -> list[Callable[[], object]]:
    """Looks at the tiles around the middle on fine cells, as a search does that begins around the last place.
    ``headings``: evenly over the circle; None: those that a compass leaves open, with their scales."""
    view, cell_m = _view(agl_m, COMPASS_RAD), matcher.cell_m(agl_m, FINE_CELL_PER_AGL)
    wide, half = WideSearch(source, GradientDescriber()), BLOCK_CELLS / 2
    blocks = sorted(blocks_of(source.bounds_m, cell_m), key=lambda b: math.hypot(b.row + half, b.column + half))
    turns = [Hypothesis(2.0 * math.pi * k / headings, 1.0) for k in range(headings)] if headings else None

    def look(frame: Image) -> None:
        seen = matcher.rectified(frame, view, turns or matcher.wide_hypotheses(view), cell_m, 1)
        wide.look([wide.describe(one) for one in seen if one is not None], blocks[:tiles], cell_m)

    return [lambda frame=frame: look(frame) for frame in frames]  # type: ignore[misc]


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
