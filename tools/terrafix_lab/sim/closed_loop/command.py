"""`terrafix sim fly`: generates a place and its map, flies over it in closed loop, and writes the report."""

from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn

from terrafix.core.errors import EvaluationError, SourceError, UsageError
from terrafix_lab.sim.autopilot.parameters import Gps
from terrafix_lab.sim.autopilot.verdict import gps_input_failure, key_figures, number
from terrafix_lab.sim.closed_loop.flight import Conditions, check_rates, plan_over
from terrafix_lab.sim.closed_loop.loop import Flown, LoopPlan, fly
from terrafix_lab.sim.flights.make import FlightOptions, check_options, gnss_events, scene_of, write_map
from terrafix_lab.sim.out_folder import prepare_folder
from terrafix_lab.sim.sensors.gnss_events import AnyEvent, Drag, Jam
from terrafix_tools.evaluate import evaluate
from terrafix_tools.mission.file import read_mission
from terrafix_tools.progress import LineProgress, waiting
from terrafix_tools.report.page import report

MARKER_FILE = "fly.json"  # a folder that contains this file may be emptied
JAM_AFTER_S = 60.0
LENGTH_KM, MAX_LENGTH_KM = 10.0, 100.0
EXIT_FAILED = 1  # exit code


@dataclass(frozen=True)
class Request:
    """Options of `terrafix sim fly` beyond those of `terrafix sim make`."""

    wanted: FlightOptions
    gps: Gps
    frame_hz: float
    spoof_after_s: float | None
    spoof_mps: float


def run(request: Request, out: Path) -> int:
    """Writes all output into ``out``. Returns exit code 0 when the autopilot flew on GPS_INPUT without fail-safe.

    Raises subclasses of TerrafixError.
    """
    wanted = request.wanted
    check_options(wanted)
    check_rates(wanted.duration_s, request.frame_hz)
    if wanted.length_km is not None and wanted.length_km > MAX_LENGTH_KM:
        raise UsageError(f"--length-km {wanted.length_km:g}: choose at most {MAX_LENGTH_KM:g}")
    if wanted.image is not None and wanted.map_path is None:
        raise UsageError("--image needs --map of the same place; use a map of another date for a meaningful result")
    conditions = Conditions(events=_events(request))
    mission = None if wanted.mission is None else read_mission(wanted.mission)
    console = Console()
    with waiting(console, "generating the ground"):
        scene, place = scene_of(wanted)
    package = out / "map.gpkg"
    plan = plan_over(
        scene,
        package,
        wanted.vehicle,
        seed=wanted.seed,
        mission=mission,
        length_m=1e3 * (LENGTH_KM if wanted.length_km is None else wanted.length_km),
        agl_m=wanted.agl_m,
        duration_s=wanted.duration_s,
        frame_hz=request.frame_hz,
        gps=request.gps,
        conditions=conditions,
    )
    prepare_folder(out, MARKER_FILE, {"seed": wanted.seed, "vehicle": wanted.vehicle.value, "gps": request.gps.value})
    with waiting(console, "writing the map"):
        write_map(package, wanted, place)
    return _report_result(_fly(plan, out, console), package, out, console)


def _events(request: Request) -> tuple[AnyEvent, ...]:
    """Events from the file and the options; by default the receiver is jammed after a minute."""
    events = list(gnss_events(request.wanted))
    if request.spoof_after_s is not None:
        if request.spoof_after_s < 0.0:
            raise UsageError(f"--spoof-after {request.spoof_after_s:g}: seconds from the start cannot be negative")
        events.append(Drag(start_s=request.spoof_after_s, east_mps=request.spoof_mps))
    return tuple(events) or (Jam(start_s=JAM_AFTER_S),)


def _fly(plan: LoopPlan, out: Path, console: Console) -> Flown:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} s of the flight"))
    with LineProgress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task(plan.name, total=None)
        return fly(plan, out, progress=lambda t_s: progress.update(task, completed=t_s))


def _report_result(flown: Flown, package: Path, out: Path, console: Console) -> int:
    try:
        evaluation = evaluate(out, out / "truth.csv")
        page = report(out, out / "truth.csv", package)
    except (SourceError, EvaluationError) as error:
        typer.echo(f"terrafix sim fly: nothing to report: {error}", err=True)
        return EXIT_FAILED
    summary, peer = flown.summary, flown.peer
    lines = [
        f"flown    {summary['flown_m'] / 1e3:.1f} km in {summary['flown_s']:.0f} s, simulated in "
        f"{summary['wall_s']:.0f} s ({summary['cpu_s']:.0f} s of processor time)",
        *key_figures(evaluation, peer),
        f"safety   {peer.failsafes} fail-safes, {peer.glitches} glitches; largest position error "
        f"{number(peer.position_error_max_m, 'm')}",
        f"report   {page}",
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    problem = gps_input_failure(peer) or ("it went into a fail-safe" if peer.failsafes else "")
    if problem:
        typer.echo(f"terrafix sim fly: GPS_INPUT was not used: {problem}", err=True)
        return EXIT_FAILED
    return 0
