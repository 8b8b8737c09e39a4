"""`terrafix demo`: a flight over a generated place, with the real processes and an autopilot that uses their GPS_INPUT.

Camera and map show the place in different seasons. The autopilot peer flies the true course and tells the link its
attitude and height over MAVLink; truth reaches nothing else. The exit code says whether the autopilot was served."""

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from terrafix.core.errors import EvaluationError, SourceError, UsageError
from terrafix_tools.report.data import gather
from terrafix_tools.report.page import report
from terrafix_tools.sim.autopilot.verdict import key_figures, not_served
from terrafix_tools.sim.demo.flight import fly
from terrafix_tools.sim.flights.folder import Flight, add_telemetry, plan_flight, write_flight
from terrafix_tools.sim.out_folder import make_room, write_json
from terrafix_tools.sim.world import place as world
from terrafix_tools.sim.world.mapped import CAMERA_SEASON, write_map

MARK = "demo.json"  # a folder with this file in it is ours to empty
SHORTEST_S, LONGEST_S = 10.0, 1800.0
NOT_SERVED = 1  # exit code


@dataclass(frozen=True)
class Made:
    """What the demo generated."""

    flight: Flight
    folder: Path
    map_path: Path


def demo(out: Path, *, seed: int, duration_s: float) -> int:
    """Everything into ``out``: map.gpkg, flight/, the record, peer.json, report.html. -> exit code.

    0 only when the autopilot got GPS_INPUT, called it healthy and used it. Raises the TerrafixError family."""
    if not SHORTEST_S <= duration_s <= LONGEST_S:
        raise UsageError(f"--duration {duration_s:g}: choose {SHORTEST_S:g} to {LONGEST_S:g} seconds")
    began_s = time.perf_counter()
    console = Console()
    make_room(out, MARK, {"seed": seed, "duration_s": duration_s})
    made = _generate(out, seed, duration_s, console)
    exit_code, peer = fly(made.flight, made.folder, made.map_path, out, seed=seed, console=console)
    peer.write(out / "peer.json")
    if exit_code != 0:
        typer.echo(
            f"terrafix demo: the daemon stopped with exit code {exit_code}; see {out / 'terrafix.log'}", err=True
        )
        return exit_code
    shutil.copyfile(made.folder / "truth.csv", out / "truth.csv")
    add_telemetry(made.folder, made.flight)  # only now: in flight it came over MAVLink
    with console.status("writing the report"):
        try:
            evaluation = gather(out, out / "truth.csv").evaluation or {}
            page = report(out, out / "truth.csv", made.map_path)
        except (SourceError, EvaluationError) as error:
            typer.echo(f"terrafix demo: nothing to report: {error}; see {out / 'terrafix.log'}", err=True)
            return NOT_SERVED
    write_json(out / "evaluation.json", evaluation)
    problem = not_served(peer)
    for line in key_figures(evaluation, peer):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"report   {page}", highlight=False, soft_wrap=True)
    console.print(f"done in {time.perf_counter() - began_s:.0f} s", highlight=False)
    if problem:
        typer.echo(f"terrafix demo: the autopilot was not served: {problem}; see {out / 'terrafix.log'}", err=True)
        return NOT_SERVED
    return 0


def _generate(out: Path, seed: int, duration_s: float, console: Console) -> Made:
    map_path, folder = out / "map.gpkg", out / "flight"
    with console.status("a place: fields, woods, a river, villages, and its map in summer"):
        place = world.generate(seed)
        write_map(place, map_path)
    with console.status("the same place in autumn, for the camera"):
        flight = plan_flight(place, place.look(CAMERA_SEASON), duration_s)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task("the camera", total=len(flight.frame_times_s()))
        write_flight(
            folder,
            flight,
            "../map.gpkg",
            seed=seed,
            telemetry=False,
            progress=lambda done, _: progress.update(task, completed=done),
        )
    length_km = flight.path.length_m(flight.duration_s) / 1e3
    frames = len(flight.frame_times_s())
    console.print(f"world    seed {seed}: map in summer, camera in autumn; {length_km:.1f} km, {frames} frames")
    return Made(flight, folder, map_path)
