"""`terrafix sim fly`: a place and its map, the closed loop over it, the table and the report."""

from dataclasses import dataclass
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from terrafix.core.errors import EvaluationError, SourceError, UsageError
from terrafix_tools.evaluate import evaluate
from terrafix_tools.mission.file import read_mission
from terrafix_tools.report.page import report
from terrafix_tools.sim.autopilot.parameters import Gps
from terrafix_tools.sim.autopilot.verdict import key_figures, not_served, number
from terrafix_tools.sim.closed_loop.flight import Conditions, check_rates, plan_over
from terrafix_tools.sim.closed_loop.loop import Flown, Plan, fly
from terrafix_tools.sim.flights.make import Wanted, check_wanted, gnss_events, scene_of, write_map
from terrafix_tools.sim.out_folder import make_room
from terrafix_tools.sim.sensors.gnss_events import AnyEvent, Drag, Jam

MARK = "fly.json"  # a folder with this file in it is ours to empty
JAM_AFTER_S = 60.0
LENGTH_KM, LONGEST_KM = 10.0, 100.0
FAILED = 1  # exit code


@dataclass(frozen=True)
class Request:
    """What the command line asks for beyond what `terrafix sim make` knows."""

    wanted: Wanted
    gps: Gps
    frame_hz: float
    spoof_after_s: float | None
    spoof_mps: float


def run(request: Request, out: Path) -> int:
    """Everything into ``out``. -> exit code: 0 when the autopilot flew on GPS_INPUT and was not led astray.

    Raises the TerrafixError family."""
    wanted = request.wanted
    check_wanted(wanted)
    check_rates(wanted.duration_s, request.frame_hz)
    if wanted.length_km is not None and wanted.length_km > LONGEST_KM:
        raise UsageError(f"--length-km {wanted.length_km:g}: choose at most {LONGEST_KM:g}")
    if wanted.image is not None and wanted.map_path is None:
        raise UsageError("--image needs --map: of the same place, and of another date if it is to prove anything")
    conditions = Conditions(events=_events(request))
    mission = None if wanted.mission is None else read_mission(wanted.mission)
    console = Console()
    with console.status("the ground"):
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
    make_room(out, MARK, {"seed": wanted.seed, "vehicle": wanted.vehicle.value, "gps": request.gps.value})
    with console.status("the map"):
        write_map(package, wanted, place)
    return _tell(_fly(plan, out, console), package, out, console)


def _events(request: Request) -> tuple[AnyEvent, ...]:
    """By file and options; without any, jammed after a minute."""
    events = list(gnss_events(request.wanted))
    if request.spoof_after_s is not None:
        if request.spoof_after_s < 0.0:
            raise UsageError(f"--spoof-after {request.spoof_after_s:g}: seconds from the start cannot be negative")
        events.append(Drag(start_s=request.spoof_after_s, east_mps=request.spoof_mps))
    return tuple(events) or (Jam(start_s=JAM_AFTER_S),)


def _fly(plan: Plan, out: Path, console: Console) -> Flown:
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed:.0f} s of the flight"))
    with Progress(*columns, TimeElapsedColumn(), console=console, transient=True) as progress:
        task = progress.add_task(plan.name, total=None)
        return fly(plan, out, progress=lambda t_s: progress.update(task, completed=t_s))


def _tell(flown: Flown, package: Path, out: Path, console: Console) -> int:
    try:
        evaluation = evaluate(out, out / "truth.csv")
        page = report(out, out / "truth.csv", package)
    except (SourceError, EvaluationError) as error:
        typer.echo(f"terrafix sim fly: nothing to report: {error}", err=True)
        return FAILED
    summary, peer = flown.summary, flown.peer
    lines = [
        f"flown    {summary['flown_m'] / 1e3:.1f} km in {summary['flown_s']:.0f} s, simulated in "
        f"{summary['wall_s']:.0f} s ({summary['cpu_s']:.0f} s of processor time)",
        *key_figures(evaluation, peer),
        f"safety   {peer.failsafes} fail-safes, {peer.glitches} glitches; at worst it was "
        f"{number(peer.position_error_max_m, 'm')} from where it believed to be",
        f"report   {page}",
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)
    problem = not_served(peer) or ("it went into a fail-safe" if peer.failsafes else "")
    if problem:
        typer.echo(f"terrafix sim fly: the autopilot was not served: {problem}", err=True)
        return FAILED
    return 0
