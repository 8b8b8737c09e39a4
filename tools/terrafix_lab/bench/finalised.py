"""The smoother after landing on simulated flights whose camera differs from its description.

python -m terrafix_lab.bench.finalised FLIGHTS OUT [SECONDS]

Flights of the Monte Carlo simulation (docs/monte-carlo.md) without faults, numbers 0 to FLIGHTS - 1, of 300 s if
nothing else is given, a frame a second. The focal length is 3 % longer than described, stated to 5 %, and the lens has
a radial coefficient that is not described. The smoother is given the factors that the flight has recorded, and what is
kept of it is chosen as by `terrafix finalise`; the truth is that of the simulation. OUT: a JSON file, written after
every flight."""

import resource
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.gate import CHI2_95
from terrafix.core.pose import tangent_to_world
from terrafix_lab.bench.result_file import write_result
from terrafix_lab.montecarlo.fault import DrawnFault
from terrafix_lab.montecarlo.flight import Run
from terrafix_lab.montecarlo.plan import FlightPlan, plan
from terrafix_lab.standalone import run_standalone
from terrafix_tools.finalise.batch_smoother import smooth
from terrafix_tools.finalise.flight_graph import FlightGraph, FlightReplayer
from terrafix_tools.finalise.held_out import EVERY, choose
from terrafix_tools.finalise.run import PlacedCamera, heights_as_seen, refined_track, solved_track

SEED, DURATION_S = 41, 300.0
FOCAL_ERROR, FOCAL_SIGMA, K1_ERROR = 0.03, 0.05, -0.03  # of the true camera, relative; as described; of the true lens


class RecordedRun(Run):
    """A simulated flight whose estimator keeps what the smoother takes."""

    def __init__(self, drawn: FlightPlan, hold_out_every: int = 0) -> None:
        self.replayer = FlightReplayer(hold_out_every)
        super().__init__(drawn, self.replayer)

    def fly(self) -> FlightGraph:
        self.record(refine=False)
        graph = self.replayer.flights[-1]
        graph.recorder.store_estimates()
        return graph

    def errors(self, placed: dict[int, PlacedCamera]) -> tuple[np.ndarray, np.ndarray]:
        """-> error of every frame, east, north and up (N, 3) [m], and its covariance (N, 3, 3), world axes."""
        errors_m, covs = [], []
        for frame_id, at in placed.items():
            errors_m.append(at.pose.translation() - self.flown.frames[frame_id].p_m)
            covs.append(tangent_to_world(at.cov, at.pose.rotation().matrix()))
        return np.array(errors_m), np.array(covs)


def uncalibrated(number: int, duration_s: float = DURATION_S) -> FlightPlan:
    """Flight ``number``, with the wrong camera."""
    drawn = plan(SEED, number, fault=DrawnFault.NONE, duration_s=duration_s)
    camera = msgspec.structs.replace(drawn.camera, focal_sigma=FOCAL_SIGMA)
    return replace(drawn, camera=camera, focal_error=FOCAL_ERROR, k1_error=K1_ERROR)


def measure(number: int, duration_s: float = DURATION_S) -> dict[str, Any]:
    """One flight -> its row of the result."""
    without, flight = (RecordedRun(uncalibrated(number, duration_s), every) for every in (EVERY, 0))
    choice = choose(without.fly())
    graph = flight.fly()
    begun_s = time.process_time()
    found = smooth(graph, estimates_lens=choice.estimates_lens)
    cpu_s = time.process_time() - begun_s
    refined = refined_track(graph, flight.replayer.estimators[-1])
    solved = solved_track(graph, found)
    refined_m = np.hypot(*flight.errors(refined)[0][:, :2].T)
    solved_m = np.hypot(*flight.errors(solved)[0][:, :2].T)
    kept = solved if choice.kept else refined
    errors_m, covs = flight.errors(kept if choice.estimates_lens else heights_as_seen(graph, kept))
    px = graph.origin.camera.fx
    before_px, after_px = (float("nan") if one is None else one * px for one in found.map_residual)
    away_m = np.hypot(*errors_m[:, :2].T)
    squares = np.einsum("ni,ni->n", errors_m[:, :2], np.linalg.solve(covs[:, :2, :2], errors_m[:, :2, None])[..., 0])
    return {
        "number": number,
        "frames": len(away_m),
        "kept": choice.kept,
        "lens": choice.estimates_lens,
        "held_out_sigmas": choice.track.sigmas if choice.track else 0.0,
        "refined_median_m": float(np.median(refined_m)),
        "refined_p95_m": float(np.percentile(refined_m, 95)),
        "solved_median_m": float(np.median(solved_m)),
        "solved_p95_m": float(np.percentile(solved_m, 95)),
        "median_m": float(np.median(away_m)),
        "p95_m": float(np.percentile(away_m, 95)),
        "max_m": float(away_m.max()),
        "up_rms_m": float(np.sqrt(np.mean(errors_m[:, 2] ** 2))),
        "up_sigma_m": float(np.sqrt(np.mean(covs[:, 2, 2]))),
        "nees": float(np.mean(squares)),
        "inside95": float(np.mean(squares <= CHI2_95)),
        "focal_error_sigmas": (found.lens.log_focal - np.log1p(FOCAL_ERROR)) / found.lens_sigma.log_focal,
        "focal_sigma": found.lens_sigma.log_focal,
        "k1_error_sigmas": (found.lens.k1 - K1_ERROR) / found.lens_sigma.k1,
        "k1_sigma": found.lens_sigma.k1,
        "map_before_px": before_px,
        "map_after_px": after_px,
        "cpu_s": cpu_s,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
    }


def main(
    flights: Annotated[int, typer.Argument(min=1, help="Flights, from number 0.")],
    out: Annotated[Path, typer.Argument(help="JSON to write.")],
    duration_s: Annotated[float, typer.Argument(metavar="[SECONDS]", help="Of each flight.")] = DURATION_S,
) -> None:
    rows: list[dict[str, Any]] = []
    for number in range(flights):
        rows.append(measure(number, duration_s))
        write_result(out, {"flights": rows})
    table = Table(title=f"{flights} simulated flights, focal length {100 * FOCAL_ERROR:+.0f} %", title_justify="left")
    for name in rows[0]:
        table.add_column(name, justify="right")
    for row in rows:
        table.add_row(*(f"{value:.3g}" for value in row.values()))
    Console(width=200).print(table)


if __name__ == "__main__":
    run_standalone("bench.finalised", main)
