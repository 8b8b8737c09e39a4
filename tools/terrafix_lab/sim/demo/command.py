"""`terrafix demo`: a flight over a generated place, with the real processes and a simulated autopilot on GPS_INPUT.

Camera and map show the place in different seasons. The autopilot peer follows the true course and sends its attitude
and height over MAVLink; no other part receives the truth. The exit code tells whether the autopilot used GPS_INPUT.
"""

import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from terrafix.core.errors import EvaluationError, SourceError, UsageError
from terrafix_lab.sim.autopilot.verdict import gps_input_failure, key_figures
from terrafix_lab.sim.demo.console import URL, DemoConsole, console_beside
from terrafix_lab.sim.demo.flight import fly
from terrafix_lab.sim.flights.folder import FRAME_HZ, Flight, add_telemetry, plan_flight, write_flight
from terrafix_lab.sim.out_folder import prepare_folder, write_json
from terrafix_lab.sim.world import place as world
from terrafix_lab.sim.world.mapped import CAMERA_SEASON, write_map
from terrafix_tools.progress import LineProgress, waiting
from terrafix_tools.report.gather import gather
from terrafix_tools.report.page import report

MARKER_FILE = "demo.json"  # a folder that contains this file may be emptied
MIN_DURATION_S, MAX_DURATION_S = 10.0, 1800.0
EXIT_FAILED = 1  # exit code


@dataclass(frozen=True)
class Generated:
    """Output of the generation."""

    flight: Flight
    folder: Path
    map_path: Path


def demo(out: Path, *, seed: int, duration_s: float, with_console: bool = False) -> int:
    """Writes map.gpkg, flight/, the record, peer.json and report.html into ``out``. Returns the exit code.

    It is 0 only when the autopilot received GPS_INPUT, reported it healthy and used it. ``with_console``: the console
    shows the flight live, and stays open after it until Ctrl-C. Raises subclasses of TerrafixError.
    """
    if not MIN_DURATION_S <= duration_s <= MAX_DURATION_S:
        raise UsageError(f"--duration {duration_s:g}: choose {MIN_DURATION_S:g} to {MAX_DURATION_S:g} seconds")
    began_s = time.perf_counter()
    console = Console()
    prepare_folder(out, MARKER_FILE, {"seed": seed, "duration_s": duration_s})
    with console_beside(out, with_console) as beside:
        exit_code = _fly_and_report(out, seed, duration_s, console, beside)
        console.print(f"done in {time.perf_counter() - began_s:.0f} s", highlight=False)
        if beside is not None and beside.runs:
            console.print(f"console  {URL} stays open until Ctrl-C", highlight=False, soft_wrap=True)
            beside.wait()
        elif beside is not None:
            typer.echo(f"terrafix demo: the console has stopped; see {out / 'console.log'}", err=True)
    return exit_code


def _fly_and_report(out: Path, seed: int, duration_s: float, console: Console, beside: DemoConsole | None) -> int:
    generated = generate(out, seed, duration_s, console)
    if beside is not None:
        console.print(f"console  {URL}", highlight=False, soft_wrap=True)
    exit_code, peer = fly(
        generated.flight,
        generated.folder,
        generated.map_path,
        out,
        seed=seed,
        console=console,
        on_start=None if beside is None else beside.start,
    )
    peer.write(out / "peer.json")
    if exit_code != 0:
        typer.echo(
            f"terrafix demo: the daemon stopped with exit code {exit_code}; see {out / 'terrafix.log'}", err=True
        )
        return exit_code
    shutil.copyfile(generated.folder / "truth.csv", out / "truth.csv")
    add_telemetry(generated.folder, generated.flight)  # after the flight, in which telemetry came over MAVLink
    with waiting(console, "writing the report"):
        try:
            evaluation = gather(out, out / "truth.csv").evaluation or {}
            page = report(out, out / "truth.csv", generated.map_path)
        except (SourceError, EvaluationError) as error:
            typer.echo(f"terrafix demo: nothing to report: {error}; see {out / 'terrafix.log'}", err=True)
            return EXIT_FAILED
    write_json(out / "evaluation.json", evaluation)
    problem = gps_input_failure(peer)
    for line in key_figures(evaluation, peer):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"report   {page}", highlight=False, soft_wrap=True)
    if problem:
        typer.echo(f"terrafix demo: GPS_INPUT was not used: {problem}; see {out / 'terrafix.log'}", err=True)
        return EXIT_FAILED
    return 0


def generate(out: Path, seed: int, duration_s: float, console: Console, frame_hz: float = FRAME_HZ) -> Generated:
    """Writes map.gpkg and flight/ into ``out``. Raises OutputError."""
    map_path, folder = out / "map.gpkg", out / "flight"
    with waiting(console, "generating a place and its summer map"):
        place = world.generate(seed)
        write_map(place, map_path)
    with waiting(console, "rendering the place in autumn for the camera"):
        flight = plan_flight(place, place.render(CAMERA_SEASON), duration_s, frame_hz)
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f}/{task.total:.0f}"))
    with LineProgress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
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
    return Generated(flight, folder, map_path)
