"""The command `terrafix chaos`."""

from dataclasses import replace
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
        Kind | None, typer.Option(help="Of a generated flight in the air; default: a copter from ground to ground.")
    ] = None,
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
    from terrafix_lab.chaos.deck import deck_in
    from terrafix_lab.chaos.recorded_scene import recorded_scene
    from terrafix_lab.chaos.run import Results, fly_matrix
    from terrafix_lab.chaos.scene import ChaosScene, scene_in
    from terrafix_lab.chaos.table import line, write_table
    from terrafix_lab.faults.fault import Need, Phase, check_flown_by
    from terrafix_lab.faults.table import FAULTS, MATRIX
    from terrafix_lab.sim.flights.folder import CAMERA, ON_GIMBAL

    faults = [f for f in FAULTS.values() if any(f.name.startswith(name) for name in fault)] if fault else [*MATRIX]
    phases = [p for p in Phase if (not phase or p.value in phase) and not ((flight or vehicle) and p is Phase.LANDING)]
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
    on_deck, elsewhere, gimbal = (
        any(need in f.needs for f in faults) for need in (Need.DECK, Need.ELSEWHERE, Need.GIMBAL)
    )
    if on_deck and (vehicle or flight or any(Need.DECK not in f.needs for f in faults)):
        raise UsageError("a start on a deck is a flight of its own, of a copter; give it as the only --fault")
    if gimbal and (flight or on_deck or any(Need.GIMBAL not in f.needs for f in faults)):
        raise UsageError("a camera on a gimbal is a flight of its own; give faults of gimbals alone, without --flight")
    if elsewhere and flight is not None:
        raise UsageError("pictures of another place are those of a generated flight; omit --flight")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another --out") from None
    results = Results(out / "results.json")
    scene: ChaosScene
    if on_deck:
        scene = deck_in(out / f"deck-{seed}", seed)
        phases = [p for p in phases if p in scene.at_s]
    elif flight is not None:
        scene = recorded_scene(flight, map_path, out)
    else:
        name = f"{vehicle or 'flight'}{'-gimbal' if gimbal else ''}"
        scene = scene_in(out / f"{name}-{seed}", seed, vehicle, camera=ON_GIMBAL if gimbal else CAMERA)
        if elsewhere:
            scene = replace(scene, elsewhere=scene_in(out / f"{name}-{seed + 1}", seed + 1, vehicle).jpeg)
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
