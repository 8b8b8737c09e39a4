"""Cost of one look at the map and how often it finds the place, by the size of its cells: python -m
terrafix_tools.bench.looks RECORD FLIGHT MAP [FRAMES].

RECORD: flight.mcap of a replay of FLIGHT over MAP. Each of FRAMES frames, evenly spaced, is correlated from a false
start: position, heading and height are wrong by what the first prediction of the flight states as 1-sigma, times a
normal random number. The place is found where the highest of all surfaces lies within a fifth of the height of the
recorded prediction."""

import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from terrafix.anchor.matching import frame_matcher
from terrafix.anchor.matching.frame_matcher import FrameMatcher, View
from terrafix.anchor.matching.predicted_view import ground_plane, view_of
from terrafix.core.camera import CameraCalibration
from terrafix.core.geodesy import LocalFrame, local_rotation_up
from terrafix.core.node import Image
from terrafix.map.package import MapPackage
from terrafix.messages import Origin, Prediction
from terrafix.recorder.reader import read_flight
from terrafix.vision.sources import open_source
from terrafix_engines.features.gradient import GradientDescriber

FOUND_PER_AGL = 0.2
HALF_M = (200.0, 400.0)  # of the window, as for a start coordinate and for a vehicle that is lost
WINDOW_CELLS = (320, 640, 1280)
FINE_HYPOTHESES = (9, 10**6)


@dataclass(frozen=True)
class Window:
    centre: tuple[float, float]
    half_m: float


def looks(record: Path, flight: Path, map_path: Path, frames: int) -> list[tuple[Image, View]]:
    """-> image and view as recorded of ``frames`` frames."""
    messages = [message for _, _, message in read_flight(record)]
    origin = next(m for m in messages if isinstance(m, Origin))
    predictions = {m.frame_id: m for m in messages if isinstance(m, Prediction)}
    local = MapPackage.open(map_path).bind(LocalFrame(origin.lat_deg, origin.lon_deg))
    chosen = set(np.array(sorted(predictions))[np.linspace(1, len(predictions) - 1, frames).astype(int)].tolist())
    found = []
    for shot in open_source(str(flight)).shots():
        if shot.frame.frame_id in chosen and shot.image is not None:
            seen = predictions[shot.frame.frame_id]
            ground = ground_plane(local, *seen.p_c_in_w_m[:2], seen.agl_m)
            found.append((shot.image, view_of(seen, ground, origin.ground_amsl_m or 0.0)))
    return found


def measure(record: Path, flight: Path, map_path: Path, frames: int) -> None:
    """Prints a row for each half width, largest window and number of fine hypotheses."""
    messages = [message for _, _, message in read_flight(record)]
    origin = next(m for m in messages if isinstance(m, Origin))
    local = MapPackage.open(map_path).bind(LocalFrame(origin.lat_deg, origin.lon_deg))
    first = view_of(next(m for m in messages if isinstance(m, Prediction)), None, origin.ground_amsl_m or 0.0)
    matcher = FrameMatcher(CameraCalibration.of(origin.camera), local, GradientDescriber())
    cases = looks(record, flight, map_path, frames)
    print("| half width | most cells | fine hypotheses | found | median z | ms |")
    for half_m in HALF_M:
        for cells in WINDOW_CELLS:
            for fine in FINE_HYPOTHESES:
                for start in ("unknown", "tracked"):
                    frame_matcher.MAX_WINDOW_CELLS, frame_matcher.MAX_FINE_HYPOTHESES = cells, fine
                    row = [_look(matcher, image, view, first if start == "unknown" else view, half_m, i)
                           for i, (image, view) in enumerate(cases)]
                    found, z, ms = zip(*row, strict=True)
                    print(f"| {half_m:.0f} | {cells} | {fine} | {start} | {sum(found)} of {len(found)} | {np.median(z):.1f} | {np.median(ms):.0f} |", flush=True)


def _look(matcher: FrameMatcher, image: Image, view: View, first: View, half_m: float, seed: int) -> tuple[bool, float, float]:
    """-> whether the place is found, its score, and milliseconds of the processor."""
    rng = np.random.default_rng(seed)
    yaw, scale, east, north = rng.normal(size=4)
    wrong = view
    if first is not view:
        turned = local_rotation_up(yaw * first.yaw_sigma_rad) @ view.r_w_c
        agl_m = view.agl_m * float(np.exp(scale * first.scale_sigma))
        wrong = replace(view, r_w_c=turned, agl_m=agl_m, yaw_sigma_rad=first.yaw_sigma_rad, scale_sigma=first.scale_sigma)
    centre = (view.e_m + 0.3 * half_m * np.tanh(east), view.n_m + 0.3 * half_m * np.tanh(north))
    began_s = time.process_time()
    result = matcher.correlate(image, wrong, Window(centre, half_m))
    elapsed_ms = (time.process_time() - began_s) * 1e3
    best = max(result.surfaces, key=lambda surface: float(np.nanmax(surface.z)))
    z, e_m, n_m = best.best(*centre, 2.0 * half_m)
    return bool(np.hypot(e_m - view.e_m, n_m - view.n_m) < FOUND_PER_AGL * view.agl_m), z, elapsed_ms


if __name__ == "__main__":
    measure(*(Path(text) for text in sys.argv[1:4]), int(sys.argv[4]) if len(sys.argv) > 4 else 12)
