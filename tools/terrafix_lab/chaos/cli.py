"""The command `terrafix chaos`."""

from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import OutputError, UsageError
from terrafix_lab.sim.autopilot.parameters import Kind

BROKEN = 1  # exit code


def chaos(
    out: Annotated[
        Path, typer.Option(help="Folder for the flight, its results and the records of broken cells.")
    ] = Path("out/chaos"),
    fault: Annotated[
        list[str] | None, typer.Option(help="Beginning of a fault's name; may be given several times.")
    ] = None,
    phase: Annotated[list[str] | None, typer.Option(help="Phase of the flight; may be given several times.")] = None,
    flight: Annotated[
        Path | None, typer.Option(help="Recorded flight folder with truth.csv, whose images and course are flown.")
    ] = None,
    map_path: Annotated[Path | None, typer.Option("--map", help="Its map; default: the one that it names.")] = None,
    vehicle: Annotated[
        Kind, typer.Option(help="Of the generated flight: copter from ground to ground, or plane in the air.")
    ] = Kind.COPTER,
    again: Annotated[bool, typer.Option("--again", help="Also fly cells that have a result.")] = False,
    seed: Annotated[int, typer.Option(help="Seed of the place and of the noise.")] = 1,
    model: Annotated[
        Path | None, typer.Option(help="Weights of XFeat for the faults of models; default: the fetched ones.")
    ] = None,
    list_only: Annotated[bool, typer.Option("--list", help="List faults and phases, and fly nothing.")] = False,
    page: Annotated[Path | None, typer.Option(help="Page whose table of results is written anew.")] = None,
) -> None:
    """Fly with each fault in each phase of a flight, with the real processes, and judge what the autopilot received.

    Results are kept in OUT/results.json; a matrix that was interrupted goes on. Exit code 1: a promise is broken, or a
    cell had no fix before its fault."""
    from terrafix_lab.chaos.recorded_scene import recorded_scene
    from terrafix_lab.chaos.run import Results, fly_matrix
    from terrafix_lab.chaos.scene import scene_in
    from terrafix_lab.chaos.table import line, write_table
    from terrafix_lab.faults.fault import Phase, check_flown_by
    from terrafix_lab.faults.table import FAULTS, MATRIX

    faults = [f for f in FAULTS.values() if any(f.name.startswith(name) for name in fault)] if fault else [*MATRIX]
    phases = [
        p
        for p in Phase
        if (not phase or p.value in phase) and not ((flight or vehicle is Kind.PLANE) and p is Phase.LANDING)
    ]
    if not faults or not phases:
        raise UsageError("no such fault or phase; 'terrafix chaos --list' names them")
    if list_only:
        typer.echo(
            "\n".join(
                [
                    "phases:",
                    *(f"  {p}" for p in Phase),
                    "faults:",
                    *(f"  {f.name:36} {f.words}".rstrip() for f in FAULTS.values()),
                ]
            )
        )
        return
    for chosen in faults:
        check_flown_by("terrafix chaos --fault", chosen)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    results = Results(out / "results.json")
    scene = (
        scene_in(out / (f"flight-{seed}" if vehicle is Kind.COPTER else f"{vehicle}-{seed}"), seed, vehicle)
        if flight is None
        else recorded_scene(flight, map_path, out)
    )
    cells = [(f, p) for p in phases for f in faults if again or not results.has(f, p)]
    for outcome in fly_matrix(scene, cells, out, results, seed=seed, model=model or _fetched_model()):
        typer.echo(line(outcome))
    if page is not None:
        write_table(page, results.outcomes, "chaos" if flight is None else f"chaos {flight.name}")
    if any(o.verdict != "ok" and "not measurable" not in o.verdict for o in results.outcomes):
        raise typer.Exit(BROKEN)


def _fetched_model() -> Path:
    from terrafix_engines.manifest import find_manifest
    from terrafix_engines.store import models_folder, stored_model

    folder = models_folder()
    return stored_model(find_manifest("xfeat", folder), folder).path
