"""Kidnapped starts: relocalisation from the middle of a flight without a position prior.

Measures the number of frames until the position is found, and the wrong results:

python -m terrafix_tools.bench.search.kidnapped FLIGHT [FLIGHT ...] [--map MAP] [--mirrored] [--tries 20] [--frames 10]
    [--stride 1] [--seed 1] [--no-compass] [--json FILE]

The flight is divided into as many sections as there are tries; each try begins at a random frame of its section, with
new nodes of ``terrafix replay`` and without a start coordinate. It takes 4 to 10 s of one core. After each flight a row
is printed, and --json written. In two tests any result is wrong: with ``--map`` of another place; and with
``--mirrored``, because a mirrored frame shows ground of the same kind that is nowhere on the map."""

import argparse
import csv
import itertools
import json
import random
import statistics
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
import typer

from terrafix.core.config import load
from terrafix.core.errors import SourceError, TerrafixError, UsageError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import with_map_center
from terrafix.core.node import NodeContext
from terrafix.map.package import MapPackage
from terrafix.messages import MapMatch, Message, NavEstimate, Origin
from terrafix.runtime.executor import InProcessShell
from terrafix.vision.sources import Source, open_source
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.replay import FRAMES_KEPT, make_nodes

RIGHT_M, RIGHT_PER_AGL = 50.0, 0.1  # largest error of a correct position: the larger of [m] and [share of the height]
CLAIM_SIGMAS = 3.2  # an incorrect position with an error of more sigmas than this counts as wrong
CLAIMED_FIX = 1.0  # heights: an estimate with a larger 1-sigma does not claim a position

Truth = dict[str, tuple[float, float]]  # file -> (lat_deg, lon_deg)


@dataclass(frozen=True)
class TryOptions:
    """``frames``: number of used frames; ``stride``: every such frame is used; ``compass``: with the autopilot's yaw;
    ``mirrored``: images with left and right exchanged."""

    frames: int
    stride: int
    compass: bool
    mirrored: bool


@dataclass(frozen=True)
class Try:
    """One kidnapped start at frame ``first``. ``found_after``: number of frames; None: not found. ``error_m``: of the
    position then. ``wrong``: number of frames with a wrong position. ``way_agl``: flown distance, in heights."""

    first: int
    found_after: int | None
    error_m: float | None
    wrong: int
    frames: int
    way_agl: float
    cpu_s_a_frame: float


def attempt(source: Source, package: Path, truth: Truth, first: int, options: TryOptions) -> Try:
    """Runs the nodes of ``terrafix replay`` from frame ``first`` on."""
    store, published = MemoryFrameStore(FRAMES_KEPT), list[Message]()
    with tempfile.TemporaryDirectory(prefix="terrafix-kidnapped-") as out:
        ctx = NodeContext(config=load([]), frames=store, map_path=package.resolve(), out_dir=Path(out))
        shell = InProcessShell(make_nodes(ctx), lambda _process, message: published.append(message))
    shell.feed(_origin_without_start(source, package))
    found_after, error_m, wrong, used, path_agl, cpu_s = None, None, 0, 0, 0.0, 0.0
    previous: tuple[float, float] | None = None
    for i, shot in enumerate(itertools.islice(source.shots(), first, first + options.frames * options.stride)):
        for state in shot.states:
            shell.feed(state if options.compass else msgspec.structs.replace(state, yaw_rad=None))
        for readings in shot.imu:
            shell.feed(readings)
        if i % options.stride:
            continue
        if shot.image is not None:
            store.put(
                shot.frame.frame_id, np.ascontiguousarray(shot.image[:, ::-1]) if options.mirrored else shot.image
            )
        published.clear()
        began_s = time.process_time()
        shell.feed(shot.frame)
        cpu_s += time.process_time() - began_s
        used += 1
        true_deg = truth.get(shot.frame.file)
        estimates = [m for m in published if isinstance(m, NavEstimate)]
        if true_deg is None or not estimates:
            continue
        estimate = estimates[-1]
        path_agl += 0.0 if previous is None else _apart_m(previous, true_deg) / estimate.agl_m
        previous = true_deg
        off_m = _apart_m(true_deg, (estimate.lat_deg, estimate.lon_deg))
        correct = not options.mirrored and off_m <= max(RIGHT_M, RIGHT_PER_AGL * estimate.agl_m)
        sigma_m = max(estimate.cov[0], estimate.cov[7]) ** 0.5
        found = any(m.search.relocalized for m in published if isinstance(m, MapMatch))
        if found and correct and found_after is None:
            found_after, error_m = used, off_m
        claims = sigma_m < CLAIMED_FIX * estimate.agl_m and off_m > CLAIM_SIGMAS * sigma_m
        wrong += not correct and (found or claims)
    return Try(first, found_after, error_m, wrong, used, round(path_agl, 2), round(cpu_s / max(used, 1), 2))


def measure(flight: str, map_path: Path | None, tries: int, seed: int, options: TryOptions) -> list[Try]:
    """-> all tries of a flight. ``map_path``: default: the map that the flight names. Raises TerrafixError."""
    source = open_source(flight)
    map_source = map_path or source.map_hint()
    if map_source is None:
        raise UsageError(f"{flight}: the flight names no map; give one with --map")
    package = ensure_package(map_source, map_cache_dir())
    truth = _truth(Path(flight))
    starts = max(1, (source.length() or 0) - options.frames * options.stride + 1)
    rng = random.Random(seed)
    first_frames = {min(int((k + rng.random()) * starts / tries), starts - 1) for k in range(tries)}
    return [attempt(source, package, truth, first, options) for first in sorted(first_frames)]


def _origin_without_start(source: Source, package: Path) -> Origin:
    """-> the origin of the source with an unknown start: the centre of the map, with a sigma as wide as the map."""
    opened = MapPackage.open(package)
    unknown = msgspec.structs.replace(source.origin(), start_sigma_m=float("inf"))
    origin = with_map_center(unknown, opened.manifest.bounds_wgs84)
    return msgspec.structs.replace(origin, ground_amsl_m=opened.ground_amsl_m(origin.lat_deg, origin.lon_deg))


def _truth(flight: Path) -> Truth:
    path = flight / "truth.csv"
    try:
        with path.open(encoding="utf-8") as lines:
            return {r["file"]: (float(r["lat_deg"]), float(r["lon_deg"])) for r in csv.DictReader(lines)}
    except (OSError, KeyError, ValueError) as error:
        raise SourceError(f"{path}: no usable truth ({error}); kidnapped starts need one") from None


def _apart_m(a: tuple[float, float], b: tuple[float, float]) -> float:
    e_m, n_m = LocalFrame(*a).to_local(*b)
    return float((e_m**2 + n_m**2) ** 0.5)


def row(name: str, tries: list[Try]) -> str:
    found = sorted(t.found_after for t in tries if t.found_after is not None)
    after = f"after {statistics.median(found):.0f} (worst {found[-1]})" if found else "never"
    return (
        f"{name:28} {len(tries):5} {len(found):5}  {after:22} {sum(t.wrong > 0 for t in tries):5}"
        f" {statistics.median(t.way_agl for t in tries):8.1f} {statistics.mean(t.cpu_s_a_frame for t in tries):8.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("flights", nargs="+", metavar="FLIGHT")
    parser.add_argument("--map", type=Path, help="instead of the map that each flight names")
    parser.add_argument("--mirrored", action="store_true", help="left and right exchanged: any result is wrong")
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--stride", type=int, default=1, help="uses every Nth frame")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--no-compass", action="store_true")
    parser.add_argument("--json", type=Path, help="writes every try")
    given = parser.parse_args()
    options = TryOptions(given.frames, given.stride, compass=not given.no_compass, mirrored=given.mirrored)
    typer.echo(f"{'flight':28} tries found  {'frames, median':22} wrong  heights  CPU s a frame")
    all_tries: dict[str, list[Try]] = {}
    try:
        for flight in given.flights:
            name = Path(flight).name
            all_tries[name] = measure(flight, given.map, given.tries, given.seed, options)
            typer.echo(row(name, all_tries[name]))
            if given.json is not None:  # after each flight, because a run of an hour may be stopped
                _write(given.json, all_tries)
    except TerrafixError as error:
        sys.exit(f"{error}")


def _write(path: Path, all_tries: dict[str, list[Try]]) -> None:
    written = {name: [asdict(t) for t in tries] for name, tries in all_tries.items()}
    path.write_text(json.dumps(written, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
