"""False alarms of the map search: flights on maps of other places.

python -m terrafix_tools.bench.search.wrong_maps FLIGHT --map MAP [--map MAP ...] [--mirrored] [--step 0.25]
    [--frames 40] [--json FILE]

Vision and estimator process the flight without a map and without a start position; each map is searched with their
predictions, one frame every ``--step`` heights. No map may show the area of the flight, unless it is ``--mirrored``.
Each row: number of segments of new ground, best log odds of a segment (90 % quantile and largest), log odds that an
acceptance required at the end, and number of accepted (wrong) positions. The last lines are the tails of all values,
in the form of a null model."""

import argparse
import itertools
import json
import math
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import msgspec
import numpy as np
import typer

from terrafix.anchor.matching.frame_matcher import FrameMatcher
from terrafix.anchor.matching.predicted_view import view_of
from terrafix.anchor.relocalization.map_search import MapSearch
from terrafix.anchor.verification.hypothesis_tracker import NEW_EVIDENCE
from terrafix.core.camera import CameraCalibration
from terrafix.core.config import load
from terrafix.core.errors import TerrafixError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.geodesy import LocalFrame
from terrafix.core.initial_position import start_is_unknown
from terrafix.core.node import Image, NodeContext
from terrafix.map.null_model import DEFAULT_NULL, TAIL_QUANTILE, FalseAlarmBudget, Tail, null_row_for
from terrafix.map.package import MapPackage
from terrafix.messages import Message, Origin, Prediction
from terrafix.runtime.executor import InProcessShell
from terrafix.vision.sources import Source, open_source
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.flight_map import map_cache_dir
from terrafix_tools.mapping.build import ensure_package
from terrafix_tools.replay import FRAMES_KEPT, make_nodes

UNKNOWN_START_M = 1000.0


@dataclass(frozen=True)
class WrongMap:
    """One flight on one map. ``places``: number of candidates. ``best``: log odds of the best hypothesis, for each
    segment of NEW_EVIDENCE heights. ``sigmas``: scores of every frame at every checked position. ``needed``: log odds
    required in the last frame. ``found``: number of frames that accepted a position."""

    places: float
    best: list[float]
    sigmas: list[float]
    needed: float
    found: int


def predicted(source: Source, *, mirrored: bool) -> Iterator[tuple[Prediction, Image]]:
    """-> every frame with its prediction by vision and estimator, without a map."""
    store, published = MemoryFrameStore(FRAMES_KEPT), list[Message]()
    with tempfile.TemporaryDirectory(prefix="terrafix-wrong-") as out:
        ctx = NodeContext(config=load([]), frames=store, map_path=None, out_dir=Path(out))
        shell = InProcessShell(make_nodes(ctx), lambda _process, message: published.append(message))
    shell.feed(_with_unknown_start(source.origin()))
    for shot in source.shots():
        for telemetry in itertools.chain(shot.states, shot.imu):
            shell.feed(telemetry)
        if shot.image is None:
            continue
        image = np.ascontiguousarray(shot.image[:, ::-1]) if mirrored else shot.image
        store.put(shot.frame.frame_id, image)
        published.clear()
        shell.feed(shot.frame)
        yield from ((m, image) for m in published if isinstance(m, Prediction))


def _with_unknown_start(origin: Origin) -> Origin:
    """-> the origin with an unknown start. If it has no coordinate, an arbitrary one: the search does not use it."""
    lat_deg, lon_deg = (0.0, 0.0) if start_is_unknown(origin) else (origin.lat_deg, origin.lon_deg)
    return msgspec.structs.replace(origin, lat_deg=lat_deg, lon_deg=lon_deg, start_sigma_m=UNKNOWN_START_M)


def searched(
    flight: Iterator[tuple[Prediction, Image]], camera: CameraCalibration, package: Path, step: float, frames: int
) -> WrongMap:
    """Searches a map with the first ``frames`` frames that are ``step`` heights apart. Raises MapError."""
    opened = MapPackage.open(package)
    west, south, east, north = opened.manifest.bounds_wgs84
    local = opened.bind(LocalFrame((south + north) / 2, (west + east) / 2))
    matcher = FrameMatcher(camera, local, GradientDescriber())
    search: MapSearch | None = None
    best, sigmas = dict[int, float](), list[float]()
    found, searched_frames, path_m, step_m, variance_m2 = 0, 0, 0.0, np.zeros(2), 0.0
    for prediction, image in flight:
        agl_m = prediction.agl_m
        if search is None:
            null = null_row_for(opened.layer().null_model, GradientDescriber.name, agl_m)
            search = MapSearch(local, matcher, agl_m, None, null, FalseAlarmBudget())
        else:
            step_m += prediction.step_m
            variance_m2 += max(prediction.step_cov_m2[0], prediction.step_cov_m2[3])
            if np.hypot(*step_m) < step * agl_m:
                continue
            search.predict(float(step_m[0]), float(step_m[1]), math.sqrt(variance_m2))
            path_m += float(np.hypot(*step_m))
            step_m, variance_m2 = np.zeros(2), 0.0
        found += search.process_frame(image, view_of(prediction, None, 0.0)) is not None
        sigmas += search.tracker.sigmas
        segment = int(path_m / (NEW_EVIDENCE * agl_m))
        best[segment] = max([best.get(segment, -math.inf), *(track.log_odds for track in search.tracker.tracks)])
        searched_frames += 1
        if searched_frames == frames:
            break
    assert search is not None
    return WrongMap(
        search.candidate_count, [v for v in best.values() if math.isfinite(v)], sigmas, search.required_evidence, found
    )


def row(name: str, result: WrongMap) -> str:
    high = float(np.quantile(result.best, TAIL_QUANTILE))
    return (
        f"{name:40} {len(result.best):9} {high:9.1f} {max(result.best):6.1f} {result.needed:7.1f} {result.found:6}"
        f" {result.places:8.0f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("flight", metavar="FLIGHT")
    parser.add_argument("--map", type=Path, action="append", required=True, help="of another place; may be repeated")
    parser.add_argument("--mirrored", action="store_true", help="left and right exchanged")
    parser.add_argument("--step", type=float, default=0.25, help="heights between frames")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--json", type=Path, help="writes every value")
    given = parser.parse_args()
    typer.echo(f"{'flight on map':40} stretches  90 % of   most  needed  found   places")
    results: dict[str, WrongMap] = {}
    try:
        source = open_source(given.flight)
        camera = CameraCalibration.of(source.origin().camera)
        for map_source in given.map:
            name = f"{Path(given.flight).name} on {map_source.stem}"
            flight = predicted(open_source(given.flight), mirrored=given.mirrored)
            package = ensure_package(map_source, map_cache_dir())
            results[name] = searched(flight, camera, package, given.step, given.frames)
            typer.echo(row(name, results[name]))
    except TerrafixError as error:
        sys.exit(f"{error}")
    typer.echo(f"sums: {Tail.fit([v for r in results.values() for v in r.best], DEFAULT_NULL.search)}")
    typer.echo(f"single frames: {Tail.fit([v for r in results.values() for v in r.sigmas], DEFAULT_NULL.frame)}")
    if given.json is not None:
        given.json.write_text(json.dumps({k: asdict(v) for k, v in results.items()}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
