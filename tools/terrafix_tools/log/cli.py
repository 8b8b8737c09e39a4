"""The commands `terrafix log ...`."""

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Flight records: contents, damage, export, parts.")

RecordArgument = Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")]
OutArgument = Annotated[Path, typer.Argument(help="Record to write (.mcap).")]
FromOption = Annotated[float, typer.Option("--from", help="Seconds since the start of the flight.")]
ToOption = Annotated[float, typer.Option("--to", help="Seconds since the start of the flight.")]
DAMAGED = 1  # exit code


@app.command()
def info(
    record: RecordArgument,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """What is in a record: files, versions, duration, frames, messages with their rates."""
    from terrafix_tools.log.contents import as_json, info_lines, read_contents

    found = read_contents(record)
    if json_only:
        typer.echo(json.dumps(as_json(found), indent=2))
        return
    for line in info_lines(found):
        typer.echo(line)


@app.command()
def check(record: RecordArgument) -> None:
    """Whether a record is complete and undamaged. Exit code 1: it is not, with a line for each damage."""
    from terrafix_tools.log.contents import read_contents

    found = read_contents(record)
    for line in found.damage:
        typer.echo(line)
    if found.damage:
        typer.echo(f"{sum(found.counts.values())} messages are readable; 'terrafix log recover' writes them anew")
        raise typer.Exit(DAMAGED)
    typer.echo(f"undamaged: {len(found.result.files)} files, {sum(found.counts.values())} messages")


@app.command()
def show(
    record: RecordArgument,
    message: Annotated[list[str] | None, typer.Option(help="Message type; may be given several times.")] = None,
    from_s: FromOption = float("-inf"),
    to_s: ToOption = float("inf"),
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what is written, until Ctrl-C.")] = False,
) -> None:
    """The messages of a record, a line each."""
    from terrafix_tools.log.show import Selection, checked_kinds, lines
    from terrafix_tools.log.show import follow as follow_lines

    selection = Selection(checked_kinds(message or []), from_s, to_s)
    try:
        for line in follow_lines(record, selection) if follow else lines(record, selection):
            typer.echo(line)
    except KeyboardInterrupt:
        raise typer.Exit(0) from None


@app.command()
def export(
    record: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    out: Annotated[Path, typer.Argument(help="File to write: .csv .parquet .geojson .kml .kmz .gpx .gpkg")],
) -> None:
    """The track in the format of the suffix of OUT."""
    from terrafix_tools.log.export import export as run_export

    typer.echo(f"{run_export(record, out)} positions; written to {out}")


@app.command()
def cut(record: RecordArgument, out: OutArgument, from_s: FromOption = 0.0, to_s: ToOption = float("inf")) -> None:
    """A record of the messages between two times."""
    from terrafix_tools.log.edit import cut as run_cut

    typer.echo(f"{run_cut(record, out, from_s, to_s)} messages; written to {out}")


@app.command()
def merge(
    records: Annotated[list[Path], typer.Argument(help="Records of one flight, oldest first.")],
    out: OutArgument,
) -> None:
    """One record of several files of one flight."""
    from terrafix_tools.log.edit import merge as run_merge

    typer.echo(f"{run_merge(records, out)} messages; written to {out}")


@app.command()
def recover(record: RecordArgument, out: OutArgument) -> None:
    """A record of everything that is readable in a damaged one."""
    from terrafix_tools.log.contents import damage_of
    from terrafix_tools.log.edit import recover as run_recover

    count, result = run_recover(record, out)
    for line in damage_of(result):
        typer.echo(line)
    typer.echo(f"{count} messages; written to {out}")
