"""The commands `terrafix log ...`."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from terrafix.core.errors import OutputError

app = typer.Typer(no_args_is_help=True, help="Flight records: contents, damage, export, parts, autopilot.")

RecordArgument = Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")]
OutArgument = Annotated[Path, typer.Argument(help="Record to write (.mcap).")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
FromOption = Annotated[float, typer.Option("--from", help="Seconds since the start of the flight.")]
ToOption = Annotated[float, typer.Option("--to", help="Seconds since the start of the flight.")]
SystemOption = Annotated[
    int, typer.Option("--system", help="MAVLink system id of the vehicle, of a .tlog with several.")
]
DAMAGED = 1  # exit code


@app.command()
def info(
    record: Annotated[Path, typer.Argument(help="Record, folder of replay or run, or an autopilot's own log.")],
    json_only: JsonOption = False,
    system: SystemOption = 0,
) -> None:
    """What is in a record: files, versions, duration, frames, messages with their rates. Or in an autopilot's log."""
    from terrafix_tools.autopilot_log.read import is_autopilot_log, read_autopilot_log

    about: dict[str, Any]
    if is_autopilot_log(record):
        from terrafix_tools.autopilot_log import text

        log = read_autopilot_log(record, system)
        about, lines = text.as_json(log), text.info_lines(log)
    else:
        from terrafix_tools.log import contents

        found = contents.read_contents(record)
        about, lines = contents.as_json(found), contents.info_lines(found)
    _print(about, lines, json_only)


@app.command()
def autopilot(
    record: RecordArgument,
    log: Annotated[Path, typer.Argument(help="Its autopilot's log: ArduPilot .bin or .log, .tlog, PX4 .ulg.")],
    json_only: JsonOption = False,
    out: Annotated[Path | None, typer.Option(help="Also write an HTML page.")] = None,
    system: SystemOption = 0,
) -> None:
    """The autopilot's own log on the time of a record: what its EKF fused, innovations, receivers, lanes, modes.

    The clocks are aligned by the attitude in both; the log of another flight is refused."""
    from terrafix_tools.autopilot_log.flight import read_flight_side
    from terrafix_tools.autopilot_log.overlay import overlay
    from terrafix_tools.autopilot_log.page import page
    from terrafix_tools.autopilot_log.read import read_autopilot_log
    from terrafix_tools.autopilot_log.text import summary

    found = overlay(read_flight_side(record), read_autopilot_log(log, system))
    if out is not None:
        try:
            out.write_text(page(found), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another file") from None
    _print(found, summary(found), json_only)


def _print(about: dict[str, Any], lines: Iterable[str], json_only: bool) -> None:
    if json_only:
        typer.echo(json.dumps(about, indent=2))
        return
    for line in lines:
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
def lines(
    record: RecordArgument,
    level: Annotated[str, typer.Option(help="debug, info, warning or error: this level and above.")] = "info",
    from_s: FromOption = float("-inf"),
    to_s: ToOption = float("inf"),
) -> None:
    """The log of a flight: what changed, was degraded or lost in any process, and what to do about it."""
    from terrafix_tools.log.lines import log_lines

    for line in log_lines(record, level, from_s, to_s):
        typer.echo(line)


@app.command()
def export(
    record: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    out: Annotated[Path, typer.Argument(help="File or folder to write.")],
    name: Annotated[str, typer.Option("--format", help="docs/exports.md; default: by the name of OUT.")] = "",
    which: Annotated[str, typer.Option(help="finalised, refined or immediate; default: the best there is.")] = "best",
    photos: Annotated[Path | None, typer.Option(help="Folder with the photos of the flight.")] = None,
) -> None:
    """Positions for other programs: GIS, Google Earth, WebODM, Pix4D, Metashape, COLMAP, ROS, geotagged photos."""
    from terrafix_tools.export.formats import export as run_export

    typer.echo(run_export(record, out, name, which, photos))


@app.command()
def layout(
    out: Annotated[Path, typer.Argument(help="File to write (.json); not over another.")] = Path(
        "terrafix-layout.json"
    ),
) -> None:
    """The layout in which Foxglove shows a record: map, frames, claims, gates, states, log. Import it there."""
    from terrafix.core.installed_files import installed_files

    file = installed_files() / "config" / "foxglove" / "terrafix-layout.json"
    try:
        with out.open("xb") as stream:
            stream.write(file.read_bytes())
    except FileExistsError:
        raise OutputError(f"{out}: exists, and is not overwritten; name another file") from None
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); choose another folder") from None
    typer.echo(f"written to {out}; Foxglove: Layouts, Import from file, then open the record")


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
