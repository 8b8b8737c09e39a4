"""Error of object positions against their stated accuracy, over a simulated flight with relief.

python -m terrafix_lab.bench.locate OUT [--seed S] [--size-km KM] [--agl M] [--vehicle copter|plane] [--length-km KM]
    [--pixels N] [--json FILE]

A flight is simulated into OUT/flight and replayed into OUT/replay, unless they are there. Random pixels of random
frames with a position are located, and compared with the intersection of the true ray and the true ground. The map of
a simulated flight is exact, while its package states an error, and a claim has that of shadows: the figures are given
for the exact map, and for a map whose error is drawn, for each pixel, from what is stated of it and of shadows."""

from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from terrafix.core.gate import CHI2_95
from terrafix.core.geodesy import LocalFrame
from terrafix.core.map_error import shared_variance_m2
from terrafix.messages import NavEstimate
from terrafix.recorder.reader import read_flight
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.sim.autopilot.parameters import Kind
from terrafix_lab.sim.camera.lens import lens_of
from terrafix_lab.sim.flights.folder import CAMERA, Flight, flight_over, mission_over
from terrafix_lab.sim.flights.make import FlightOptions, make, scene_of
from terrafix_lab.standalone import run_standalone
from terrafix_tools.locate.locator import FlightLocator
from terrafix_tools.replay import replay
from terrafix_tools.replay_output import SUMMARY

TRUTH_SEED = 7  # of the pixels that are drawn


@dataclass(frozen=True)
class Accuracy:
    """Of horizontal errors. ``nees``: mean squared Mahalanobis distance, 2 if the stated covariance is right."""

    pixels: int
    median_m: float
    p95_m: float
    inside_95: float
    nees: float


@dataclass(frozen=True)
class Located:
    """Error (2,) of a pixel, east and north, with stated covariance (2, 2); stated 1-sigma of the map's error and of
    shadows."""

    error_m: np.ndarray
    cov_m2: np.ndarray
    map_sigma_m: float
    surface: str


def simulate(out: Path, wanted: FlightOptions) -> Flight:
    """The flight in OUT/flight and its replay in OUT/replay; what is there already is not computed again."""
    folder, replayed = out / "flight", out / "replay"
    if (folder / "flight.toml").is_file():
        scene, _ = scene_of(wanted)
        length_m = 1e3 * (wanted.length_km or 1.0)
        mission = mission_over(scene, wanted.vehicle, seed=wanted.seed, length_m=length_m, agl_m=wanted.agl_m)
        flight = flight_over(scene, wanted.vehicle, seed=wanted.seed, mission=mission)
    else:
        flight = make(folder, wanted)
    if not (replayed / SUMMARY).is_file():
        replay(folder, None, replayed)
    return flight


def locate_pixels(flight: Flight, replayed: Path, count: int) -> list[Located]:
    """Random pixels of random frames; pixels that show no ground are not counted."""
    locator = FlightLocator.open(replayed)
    estimates = [m for _, _, m in read_flight(replayed) if isinstance(m, NavEstimate)]
    map_sigma_m = {m.frame_id: shared_variance_m2(m.map_sigma_m) ** 0.5 for m in estimates}
    times_s = flight.frame_times_s()
    lens, random = lens_of(CAMERA), np.random.default_rng(TRUTH_SEED)
    frame_ids = sorted(locator.flight.views)
    found: list[Located] = []
    while len(found) < count:
        frame_id = int(random.choice(frame_ids))
        pixel = random.uniform((0.0, 0.0), (CAMERA.width - 1.0, CAMERA.height - 1.0))
        file = locator.flight.frames[frame_id].file
        p_m, r_w_c = flight.camera_pose(flight.path.state(float(times_s[int(file.split(".")[0]) - 1])))
        ray = r_w_c @ lens.rays(pixel[None])[0]
        distance_m = float(flight.ground.relief.intersect(p_m[None], ray[None])[0])
        if not np.isfinite(distance_m):
            continue
        position = locator.locate([(file, (float(pixel[0]), float(pixel[1])))])
        truth_m = _same_frame(p_m + distance_m * ray, flight.frame, locator.flight.frame)
        found.append(
            Located(position.p_m[:2] - truth_m, position.cov[:2, :2], map_sigma_m[frame_id], str(position.surface))
        )
    return found


def accuracy(found: list[Located], *, map_errors: bool) -> Accuracy:
    """``map_errors``: with an error of the map as stated, drawn for each pixel."""
    random = np.random.default_rng(TRUTH_SEED)
    sigma_m = np.array([pixel.map_sigma_m for pixel in found])[:, None] * float(map_errors)
    errors_m = np.array([pixel.error_m for pixel in found]) + sigma_m * random.standard_normal((len(found), 2))
    stated = np.array([pixel.cov_m2 for pixel in found])
    nees = np.einsum("ni,nij,nj->n", errors_m, np.linalg.inv(stated), errors_m)
    length_m = np.hypot(*errors_m.T)
    return Accuracy(
        pixels=len(found),
        median_m=float(np.median(length_m)),
        p95_m=float(np.percentile(length_m, 95)),
        inside_95=float((nees <= CHI2_95).mean()),
        nees=float(nees.mean()),
    )


def _same_frame(p_m: np.ndarray, of: LocalFrame, to: LocalFrame) -> np.ndarray:
    """East and north (2,) of a point in another local frame."""
    return np.array(to.to_local(*of.to_wgs84(float(p_m[0]), float(p_m[1]))))


def bench(
    out: Annotated[Path, typer.Argument(help="Folder for the flight and its replay.")],
    seed: Annotated[int, typer.Option(help="Of place, course and errors.")] = 3,
    size_km: Annotated[float, typer.Option(help="Side of the generated place.")] = 1.2,
    agl: Annotated[float, typer.Option(help="Height of the course above ground, metres.")] = 100.0,
    vehicle: Annotated[Kind, typer.Option(help="Vehicle type.")] = Kind.COPTER,
    length_km: Annotated[float, typer.Option(help="Length of the course.")] = 1.0,
    pixels: Annotated[int, typer.Option(help="Number of pixels.")] = 1000,
    json_path: Annotated[Path | None, typer.Option("--json", help="File for the numbers of the table.")] = None,
) -> None:
    """Compare the error of object positions with their stated accuracy."""
    wanted = FlightOptions(seed=seed, size_km=size_km, vehicle=vehicle, length_km=length_km, agl_m=agl)
    found = locate_pixels(simulate(out, wanted), out / "replay", pixels)
    result: dict[str, Any] = {
        "map_as_stated": asdict(accuracy(found, map_errors=True)),
        "exact_map": asdict(accuracy(found, map_errors=False)),
        "surfaces": dict(Counter(pixel.surface for pixel in found)),
    }
    write_result(json_path, result)
    typer.echo("map          pixels  median m  p95 m  inside 95 %  NEES (2)")
    for name in ("map_as_stated", "exact_map"):
        row = result[name]
        typer.echo(
            f"{name:13}{row['pixels']:6}{row['median_m']:10.2f}{row['p95_m']:7.2f}{100 * row['inside_95']:11.1f} %"
            f"{row['nees']:10.2f}"
        )
    typer.echo(", ".join(f"{surface} {number}" for surface, number in result["surfaces"].items()))


if __name__ == "__main__":
    run_standalone("locate", bench)
