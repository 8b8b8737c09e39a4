"""The commands `terrafix fleet ...`."""

from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import UsageError

app = typer.Typer(no_args_is_help=True, help="Many flights: tables of their records, queries, a page of trends.")

FleetArgument = Annotated[Path, typer.Argument(metavar="DIR", help="Folder that 'terrafix fleet build' has written.")]
UNREADABLE = 1  # exit code


@app.command()
def build(
    source: Annotated[
        str, typer.Argument(metavar="FOLDER_OR_BUCKET", help="Folder with records below it; s3://... or gs://...")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the fleet.")] = Path("out/fleet"),
    workers: Annotated[
        int | None, typer.Option(min=1, max=64, help="Processes that read; default: one per core, at most 8.")
    ] = None,
    scheduler: Annotated[str, typer.Option(help="tcp://host:port of a Dask cluster to use instead.")] = "",
) -> None:
    """Read all flight records below a folder into tables. A second build adds what is new or has grown.

    Exit code 1: some records could not be read; each is named with the reason."""
    from terrafix_tools.fleet.build import build as run_build
    from terrafix_tools.parallel.pool import default_workers

    result = run_build(source, out, workers=workers or default_workers(), scheduler=scheduler, progress=True)
    for path, reason in result.errors:
        typer.echo(f"{path}: {reason}", err=True)
    typer.echo(
        f"{result.found} records, {result.unchanged} of them unchanged, {len(result.errors)} not readable; "
        f"{result.new} flights added, {result.grown} grown; {result.flights} flights in {out}"
    )
    if result.errors:
        raise typer.Exit(UNREADABLE)


@app.command()
def query(
    fleet: FleetArgument,
    sql: Annotated[str, typer.Argument(metavar="SQL", help="One SELECT over flights, frames, records and errors.")],
    json_rows: Annotated[bool, typer.Option("--json", help="Print JSON, one object a row.")] = False,
    csv_rows: Annotated[bool, typer.Option("--csv", help="Print CSV.")] = False,
) -> None:
    """Ask the tables of a fleet by SQL (DuckDB); nothing can be changed or written."""
    from terrafix_tools.fleet.query import print_csv, print_json, print_table, query

    if json_rows and csv_rows:
        raise UsageError("--json and --csv: choose one of them")
    answer = query(fleet, sql)
    (print_json if json_rows else print_csv if csv_rows else print_table)(answer)


@app.command()
def page(
    fleet: FleetArgument,
    out: Annotated[Path, typer.Option(help="HTML page to write.")] = Path("out/fleet.html"),
) -> None:
    """Write one page without other files: trends by map, season, camera, height and version; where it fails."""
    from terrafix_tools.fleet.page import write_page

    write_page(fleet, out)
    typer.echo(out)
