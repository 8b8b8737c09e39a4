"""The command `terrafix accept`."""

from pathlib import Path
from typing import Annotated

import typer

BROKEN_FLOOR = 1  # exit code


def accept(
    flight: Annotated[str, typer.Argument(help="Flight folder, photos or video; default: a generated world.")] = "",
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map package or GeoTIFF; default: the flight's.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="truth.csv (file, lat_deg, lon_deg) or coordinates.csv (image, lat, lon); default: in FLIGHT."
        ),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for the table and every scenario's replay.")] = Path("out/accept"),
    scenario: Annotated[list[str] | None, typer.Option(help="Only this scenario; may be given several times.")] = None,
    lies: Annotated[
        bool, typer.Option("--lies", help="The scenarios with false inputs, instead of the ordinary ones.")
    ] = False,
    other_map: Annotated[
        Path | None, typer.Option(help="GeoTIFF of another town, for the scenarios that fly with one.")
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="Scenarios at a time; each keeps a core busy.")] = 2,
    quick: Annotated[
        bool, typer.Option("--quick", help="120 frames of each flight; leaves the three long scenarios out.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Keep the results that are in --out already.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the generated world and of the map's error.")] = 1,
    model: Annotated[list[str] | None, typer.Option(help="Name of a fetched model (xfeat), or NAME=PATH.")] = None,
    config: Annotated[
        list[Path] | None, typer.Option("--config", help="TOML file; may be given several times.")
    ] = None,
) -> None:
    """The acceptance table AC-1 to AC-17 over named scenarios.

    Exit code 0: all floors hold, known shortfalls aside; 1: one does not."""
    from terrafix_lab.accept.run import AcceptOptions, truth_of
    from terrafix_lab.accept.run import accept as run_accept
    from terrafix_lab.accept.table import headline

    options = AcceptOptions(
        out=out,
        flight=flight,
        map_path=map_path,
        truth=truth_of(flight, truth),
        scenarios=tuple(scenario or ()),
        quick=quick,
        resume=resume,
        seed=seed,
        models=tuple(model or ()),
        configs=tuple(config or ()),
        lies=lies,
        other_map=other_map,
        workers=workers,
    )
    acceptance = run_accept(options)
    typer.echo(f"{headline(acceptance)} Written to {out / 'acceptance.html'}")
    raise typer.Exit(BROKEN_FLOOR if acceptance.broken else 0)
