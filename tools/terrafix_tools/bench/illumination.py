"""Displacement that all matches of a frame share although the map is exact: shadows of another sun than the map's.

python -m terrafix_tools.bench.illumination OUT [--flights N] [--seconds S]

Generated flights, by copter and plane at 100 and 150 m, are flown and replayed in OUT, a new folder. With the true pose
of the camera each matched pixel is projected onto the ground; the table has the mean over a frame of matched point less
true ground, as root mean square over the frames (the larger one is ILLUMINATION_SIGMA_M of
terrafix/core/map_error.py)."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from terrafix.core.errors import OutputError
from terrafix.core.geodesy import LocalFrame
from terrafix.messages import MapMatch, Origin, Verdict
from terrafix.recorder.reader import read_flight
from terrafix_tools.replay import replay
from terrafix_tools.sim.autopilot.parameters import Kind
from terrafix_tools.sim.flights.folder import Flight
from terrafix_tools.sim.flights.make import MAP_NAME, FlightOptions, make
from terrafix_tools.standalone import run_standalone

FALSE_M = 15.0  # a frame that is matched elsewhere is not displaced


def displacements(flight: Flight, replayed: Path) -> np.ndarray:
    """(N, 2) metres, east and north: of each frame with accepted matches, the mean displacement."""
    messages = [message for _, _, message in read_flight(replayed)]
    origin = next(m for m in messages if isinstance(m, Origin))
    axes = LocalFrame(origin.lat_deg, origin.lon_deg)
    means = [
        _displacement(flight, axes, match)
        for match in messages
        if isinstance(match, MapMatch) and match.verdict is Verdict.ACCEPTED and match.matches
    ]
    found = np.array(means).reshape(-1, 2)
    return found[np.hypot(*found.T) < FALSE_M]


def _displacement(flight: Flight, axes: LocalFrame, match: MapMatch) -> np.ndarray:
    """Mean (2,) of matched points less the true ground of their pixels."""
    p_m, r_w_c = flight.camera_pose(flight.path.state(match.t_ns / 1e9))
    lat_deg, lon_deg = flight.frame.to_wgs84(float(p_m[0]), float(p_m[1]))
    here_m = np.array([*axes.to_local(lat_deg, lon_deg), p_m[2]])
    rows = np.array(match.matches)
    rays = np.column_stack([rows[:, :2], np.ones(len(rows))]) @ r_w_c.T
    along = (rows[:, 4] - here_m[2]) / rays[:, 2]
    ground_m = here_m[:2] + along[:, None] * rays[:, :2]
    return np.asarray((rows[:, 2:4] - ground_m).mean(axis=0))


def main(
    out: Annotated[Path, typer.Argument(help="New folder for the flights.")],
    flights: Annotated[int, typer.Option(min=1, help="Number of places, with seeds from 2 on.")] = 8,
    seconds: Annotated[float, typer.Option(help="Of each flight.")] = 60.0,
) -> None:
    if out.exists():
        raise OutputError(f"{out}: exists; give a new folder")
    table = Table(title="Mean displacement of a frame's matches, exact map", title_justify="left")
    for name in ("seed", "frames", "mean e, n", "rms e, n", "95 %", "largest"):
        table.add_column(name, justify="right")
    rows = []
    for number in range(2, 2 + flights):
        folder = out / f"flight-{number}"
        agl_m = 100.0 if number % 3 else 150.0
        kind = Kind.COPTER if number % 2 else Kind.PLANE
        flight = make(folder, FlightOptions(seed=number, vehicle=kind, duration_s=seconds, agl_m=agl_m), progress=False)
        replay(folder, folder / MAP_NAME, out / f"replay-{number}")
        rows.append(displacements(flight, out / f"replay-{number}"))
        table.add_row(str(number), *_cells(rows[-1]))
    table.add_row("all", *_cells(np.vstack(rows)))
    Console(width=120).print(table)


def _cells(moved_m: np.ndarray) -> list[str]:
    length_m = np.hypot(*moved_m.T)
    mean, rms = moved_m.mean(axis=0), np.sqrt(np.mean(moved_m**2, axis=0))
    return [
        str(len(moved_m)),
        f"{mean[0]:.2f}, {mean[1]:.2f} m",
        f"{rms[0]:.2f}, {rms[1]:.2f} m",
        f"{np.percentile(length_m, 95):.1f} m",
        f"{length_m.max():.1f} m",
    ]


if __name__ == "__main__":
    run_standalone("bench.illumination", main)
