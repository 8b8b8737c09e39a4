"""Cost of one look at the map and how often it finds the place, by the size of its cells.

python -m terrafix_tools.bench.looks RECORD FLIGHT MAP [--frames N]

RECORD: flight.mcap of a replay of FLIGHT over MAP. N frames, evenly spaced, are correlated in windows whose centre
is up to 0.3 half widths from the recorded prediction. The place is found where the highest of all surfaces lies within
a fifth of the height of that prediction."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from terrafix.anchor.matching import frame_matcher
from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.predicted_view import ground_plane, view_of
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, local_rotation_up
from terrafix.core.node import Image
from terrafix.map.package import LocalMap, MapPackage
from terrafix.messages import Message, Origin, Prediction
from terrafix.recorder.reader import read_flight
from terrafix.vision.sources import open_source
from terrafix_engines.features.gradient import GradientDescriber
from terrafix_tools.standalone import run_standalone

FOUND_PER_AGL = 0.2
START_HALF_M = 200.0  # half width of the window around a start coordinate
WIDE_HALF_M = (200.0, 400.0, 800.0)  # of those of a vehicle that is lost
WINDOW_CELLS = (160, 320, 640, 1280)
ALL_FINE = 10**6
FINE_HYPOTHESES = (5, 9, ALL_FINE)


@dataclass(frozen=True)
class Window:
    centre: tuple[float, float]
    half_m: float


def looks(messages: Sequence[Message], flight: Path, local: LocalMap, frames: int) -> list[tuple[Image, View]]:
    """-> image and view as recorded of ``frames`` frames."""
    origin = next(m for m in messages if isinstance(m, Origin))
    predictions = {m.frame_id: m for m in messages if isinstance(m, Prediction)}
    chosen = set(np.array(sorted(predictions))[np.linspace(1, len(predictions) - 1, frames).astype(int)].tolist())
    found = []
    for shot in open_source(str(flight)).shots():
        if shot.frame.frame_id in chosen and shot.image is not None:
            seen = predictions[shot.frame.frame_id]
            ground = ground_plane(local, *seen.p_c_in_w_m[:2], seen.agl_m)
            found.append((shot.image, view_of(seen, ground, origin.ground_amsl_m or 0.0)))
    return found


def main(
    record: Annotated[Path, typer.Argument(help="flight.mcap of a replay.")],
    flight: Annotated[Path, typer.Argument(help="Folder of that flight.")],
    map_path: Annotated[Path, typer.Argument(metavar="MAP", help="Map package of that replay.")],
    frames: Annotated[int, typer.Option(min=1, help="Frames, evenly spaced.")] = 12,
) -> None:
    """Prints a row for each window and its most cells, heading and height as predicted, and for each number of fine
    hypotheses, both as at the start of the flight."""
    messages = [message for _, _, message in read_flight(record)]
    origin = next(m for m in messages if isinstance(m, Origin))
    local = MapPackage.open(map_path).bind(LocalFrame(origin.lat_deg, origin.lon_deg))
    first = view_of(next(m for m in messages if isinstance(m, Prediction)), None, origin.ground_amsl_m or 0.0)
    matcher = FrameMatcher(CameraCalibration.of(origin.camera), local, GradientDescriber())
    cases = looks(messages, flight, local, frames)
    known = [(image, view, view) for image, view in cases]
    unknown = [(image, view, _as_at_the_start(view, first, seed)) for seed, (image, view) in enumerate(cases)]
    typer.echo("| window, m | most cells | found | median z | ms |")
    usual = frame_matcher.MAX_WINDOW_CELLS
    for half_m in WIDE_HALF_M:
        for frame_matcher.MAX_WINDOW_CELLS in WINDOW_CELLS:
            typer.echo(f"| {2 * half_m:.0f} | {frame_matcher.MAX_WINDOW_CELLS} | {_row(matcher, known, half_m)} |")
    frame_matcher.MAX_WINDOW_CELLS = usual
    typer.echo("| fine hypotheses | found | median z | ms |")
    for count in FINE_HYPOTHESES:
        frame_matcher.MAX_FINE_HYPOTHESES = count
        typer.echo(f"| {count} | {_row(matcher, unknown, START_HALF_M)} |")


def _as_at_the_start(view: View, first: View, seed: int) -> View:
    yaw, scale = np.random.default_rng(seed).normal(size=2)
    return replace(
        view,
        r_w_c=local_rotation_up(yaw * first.yaw_sigma_rad) @ view.r_w_c,
        agl_m=view.agl_m * float(np.exp(scale * first.scale_sigma)),
        yaw_sigma_rad=first.yaw_sigma_rad,
        scale_sigma=first.scale_sigma,
    )


def _row(matcher: FrameMatcher, cases: list[tuple[Image, View, View]], half_m: float) -> str:
    """``cases``: image, view as recorded, view that is given."""
    found, scores, times_ms = 0, [], []
    for seed, (image, true, given) in enumerate(cases):
        east, north = np.random.default_rng(seed + 1000).uniform(-0.3, 0.3, 2) * half_m
        centre = (true.e_m + east, true.n_m + north)
        began_s = time.process_time()
        result = matcher.correlate(image, given, Window(centre, half_m))
        times_ms.append((time.process_time() - began_s) * 1e3)
        z, e_m, n_m = max(surface.best(*centre, 2.0 * half_m) for surface in result.surfaces)
        found += bool(np.hypot(e_m - true.e_m, n_m - true.n_m) < FOUND_PER_AGL * true.agl_m)
        scores.append(z)
    return f"{found} of {len(cases)} | {np.median(scores):.1f} | {np.median(times_ms):.0f}"


if __name__ == "__main__":
    run_standalone("bench.looks", main)
