"""The command line `terrafix`. Each command imports its modules when it is called, so that --help is fast."""

import contextlib
import errno
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core
import typer.main

from terrafix import __version__
from terrafix.core.errors import OutputError, TerrafixError, UsageError

if TYPE_CHECKING:
    from terrafix.runtime.fork_server import ForkServer
    from terrafix.runtime.run_dir import RunDir

# Modules that are not on a vehicle, by the extra that brings them: how their names begin.
EXTRAS = {
    "console": (
        "fastapi", "starlette", "uvicorn", "sqlalchemy", "python_multipart", "pydantic",
        "terrafix_tools.console",
    ),
    "ground": ("rasterio", "urllib3", "pmtiles", "osmium", "pyogrio", "pyarrow", "pyulog", "yaml", "terrafix_"),
    "rosbag": ("rosbags",),
    "fleet": ("duckdb",),
    "sim": ("mavsdk",),
}  # fmt: skip
# a full disk, or one over its quota
NO_SPACE = (errno.ENOSPC, errno.EDQUOT)

# Commands of modules of their own: a function, or a Typer app with commands below it. Imported when they are called, so
# that a start in flight is fast. The lab is named here and imported by nothing: it may not be installed.
MODULES = {
    "init": "terrafix_tools.configuration.cli:init",
    "config": "terrafix_tools.configuration.cli:app",
    "preflight": "terrafix_tools.preflight.cli:preflight",
    "status": "terrafix_tools.status.cli:status",
    "hint": "terrafix_tools.hint.cli:hint",
    "log": "terrafix_tools.log.cli:app",
    "source": "terrafix_tools.source.cli:app",
    "camera": "terrafix_tools.camera.cli:app",
    "files": "terrafix_tools.files.cli:files",
    "models": "terrafix_tools.models.cli:app",
    "map": "terrafix_tools.mapping.cli:app",
    "finalise": "terrafix_tools.finalise.cli:finalise",
    "compare": "terrafix_tools.compare.cli:compare",
    "locate": "terrafix_tools.locate.cli:locate",
    "fleet": "terrafix_tools.fleet.cli:app",
    "serve": "terrafix_tools.console.cli:serve",
    "flight": "terrafix_tools.console.flight_cli:app",
    "demo": "terrafix_lab.sim.demo.cli:demo",
    "sim": "terrafix_lab.sim.cli:app",
    "accept": "terrafix_lab.accept.cli:accept",
    "montecarlo": "terrafix_lab.montecarlo.cli:montecarlo",
    "chaos": "terrafix_lab.chaos.cli:chaos",
    "bench": "terrafix_lab.bench.cli:bench",
}

# Of the help, in the order of a flight. A command that is in none is a mistake (tests/unit/project/test_cli_help.py).
GROUPS = {
    "Fly": ("run", "status", "hint"),
    "Before a flight": ("init", "config", "preflight", "camera", "source", "files", "models"),
    "After a flight": ("replay", "report", "evaluate", "finalise", "log", "compare", "locate", "fleet"),
    "Photos and flights over HTTP": ("serve", "flight"),
    "Maps": ("map",),
    "Simulate and measure": ("demo", "sim", "accept", "montecarlo", "chaos", "bench"),
}


def _load(name: str) -> Any:
    """The command ``name`` of MODULES. Raises ModuleNotFoundError where its package is not installed."""
    path, attribute = MODULES[name].split(":")
    module = importlib.import_module(path)
    loaded = getattr(module, attribute)
    holder = typer.Typer(add_completion=False)
    if isinstance(loaded, typer.Typer):
        holder.add_typer(loaded, name=name)
    else:
        holder.command(name, context_settings=getattr(module, "CONTEXT", None))(loaded)
    return typer.main.get_group(holder).commands[name]


def _is_installed(path: str) -> bool:
    try:
        return importlib.util.find_spec(path.split(":")[0]) is not None
    except ModuleNotFoundError:
        return False


class _Commands(typer.core.TyperGroup):
    """The commands of this module and those of MODULES; the help leaves out what is not installed."""

    def list_commands(self, ctx: Any) -> list[str]:
        installed = {*super().list_commands(ctx), *(name for name, path in MODULES.items() if _is_installed(path))}
        return [name for names in GROUPS.values() for name in names if name in installed]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        command: Any = _load(cmd_name) if cmd_name in MODULES else super().get_command(ctx, cmd_name)
        if command is not None:
            command.rich_help_panel = next((group for group, names in GROUPS.items() if cmd_name in names), None)
            _show_brackets(command)
        return command


def _show_brackets(command: Any) -> None:
    """Brackets in the help of ``command`` and of those below it are text: Rich would take "[source]" for markup."""
    for item in (command, *command.params):
        item.help = re.sub(r"\[(?=[a-z#/@])", r"\\[", item.help) if getattr(item, "help", None) else None
    for below in getattr(command, "commands", {}).values():
        _show_brackets(below)


app = typer.Typer(no_args_is_help=True, cls=_Commands, context_settings={"help_option_names": ["-h", "--help"]})

StartOption = Annotated[str, typer.Option("--start", help="LAT,LON in degrees where the flight starts.")]
ConfigOption = Annotated[list[Path] | None, typer.Option("--config", help="TOML file; may be given several times.")]


def _show_version(wanted: bool) -> None:
    if wanted:
        from terrafix.recorder.provenance import git_describe

        commit = git_describe()
        typer.echo(f"terrafix {__version__}{f' ({commit})' if commit else ''}, Python {sys.version.split()[0]}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version and exit.")
    ] = False,
) -> None:
    """Position without GNSS: a camera and a map."""


@contextlib.contextmanager
def _run_line() -> Iterator["Callable[[RunDir], None] | None"]:
    """What prints the line of a run. Only a terminal imports it: the vehicle starts faster without."""
    if not sys.stderr.isatty():
        yield None
        return
    from terrafix_tools.status.line import RunLine

    with RunLine() as line:
        yield line.start


@app.command()
def run(
    context: typer.Context,
    source: Annotated[str, typer.Option(help="Flight folder, photos, video, camera: docs/camera.md.")] = "",
    map_path: Annotated[Path | None, typer.Option("--map", help="Map package or GeoTIFF.")] = None,
    link: Annotated[str, typer.Option(help="udpin:H:P, udpout:H:P, tcp:H:P or a serial device.")] = "",
    out: Annotated[Path, typer.Option(help="Folder for the flight record.")] = Path("out/run"),
    start: StartOption = "",
    until_end: Annotated[bool, typer.Option("--until-end", help="Stop when a recorded source has ended.")] = False,
    config: ConfigOption = None,
) -> None:
    """Fly: start the processes under the supervisor until stopped.

    In a terminal it prints once a second where it is and why, on stderr; logs are on stdout."""
    from terrafix.runtime import supervisor

    options = supervisor.RunOptions(
        out_dir=out,
        configs=config or [],
        source=source,
        map_path=map_path,
        link=link,
        start=start,
        stop_after_source=until_end,
    )
    previous_run = supervisor.recently_killed_spec(options)
    if previous_run is not None:
        options = replace(options, ground_amsl_m=previous_run.ground_amsl_m)
    else:
        from terrafix_tools.live import package_for_in_child

        package, ground_amsl_m = package_for_in_child(source, start, map_path, config or [])
        options = replace(options, map_path=package, ground_amsl_m=ground_amsl_m)
    with _run_line() as on_run_dir:
        callbacks = supervisor.RunCallbacks(on_run_dir=on_run_dir)
        code = supervisor.run(options, callbacks, fork_server=context.obj)
    if until_end and code == 0:  # not at a shutdown of the vehicle: reading a long record takes too long
        from terrafix_tools.flight_verdict import verdict_of

        typer.echo(verdict_of(out).text(), err=True)
    raise typer.Exit(code)


@app.command()
def replay(
    flight: Annotated[Path, typer.Argument(help="Flight folder, photo folder, video, ROS bag, or flight record.")],
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map package or GeoTIFF; default: the flight's.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for estimates.csv, flight.mcap, summary.json.")] = Path(
        "out/replay"
    ),
    model: Annotated[list[str] | None, typer.Option(help="Name of a fetched model (xfeat), or NAME=PATH.")] = None,
    start: StartOption = "",
    config: ConfigOption = None,
    topic: Annotated[list[str] | None, typer.Option(help="KIND=TOPIC of a ROS bag: docs/flight-folder.md.")] = None,
    frames: Annotated[
        bool, typer.Option("--frames", help="Of a record with frames: compute vision and map matching again, too.")
    ] = False,
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """Replay a recorded flight as fast as this machine can; the same input gives the same output.

    A flight record (.mcap, or the folder of a run) is replayed from its messages: the estimator computes again. With
    --frames all of it is computed again from its frames, also with another map, model or configuration."""
    from terrafix.recorder.reader import is_record
    from terrafix.vision.sources import parse_start, parse_topics
    from terrafix.vision.sources.bag_topics import is_bag
    from terrafix_tools.replay import replay as run_replay
    from terrafix_tools.rerun.frames import RecordedFrames

    source: Path | RecordedFrames = flight
    if is_record(flight) and not is_bag(flight):
        if not frames:
            _replay_from_messages(flight, out, other_inputs=bool(map_path or model or start or config), quiet=quiet)
            return
        if start:
            raise UsageError(f"{flight}: the start is that of the record; omit --start")
        source = RecordedFrames(flight)
    elif frames:
        raise UsageError(f"{flight}: --frames is for flight records; omit it")
    summary = run_replay(
        source,
        map_path,
        out,
        models=model or [],
        configs=config or [],
        progress=not quiet,
        start=parse_start(start),
        topics=parse_topics(topic or []),
    )
    if summary["verdict"]["active_faults"]:
        raise typer.Exit(1)


def _replay_from_messages(record: Path, out: Path, *, other_inputs: bool, quiet: bool) -> None:
    """Raises UsageError for options that have no effect on the estimator alone."""
    from terrafix_tools.rerun.run import replay_record

    if other_inputs:
        raise UsageError(
            f"{record}: a record is replayed from its messages, without map and models; omit --map, --model, --start "
            "and --config, or add --frames if the record has its frames, or replay the source of the flight"
        )
    replay_record(record, out, progress=not quiet)


@app.command()
def evaluate(
    folder: Annotated[Path, typer.Argument(help="Output of replay.")],
    truth: Annotated[Path, typer.Option(help="truth.csv: file, lat_deg, lon_deg.")],
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare estimates with ground truth; writes evaluation.json."""
    from terrafix_tools.evaluate import evaluate as run_evaluate

    run_evaluate(folder, truth, json_only=json_only)


@app.command()
def report(
    folder: Annotated[Path, typer.Argument(help="Output of replay, run or demo.")],
    truth: Annotated[Path | None, typer.Option(help="truth.csv, if available.")] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map package; default: the one in summary.json.")
    ] = None,
) -> None:
    """Write one self-contained HTML page about a flight: FOLDER/report.html."""
    from terrafix_tools.report.page import report as run_report

    typer.echo(run_report(folder, truth, map_path))


def _printable(text: str) -> str:
    """One line in any encoding: names of files may hold line breaks, and bytes that are no UTF-8."""
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def main(fork_server: "ForkServer | None" = None) -> None:
    """Runs the command line. A TerrafixError ends with one line and its exit code, any other exception is a traceback.

    ``fork_server``: for `run`, a fork server that is already started (program.py).
    """
    try:
        app(obj=fork_server)
    except TerrafixError as error:
        typer.echo(f"terrafix: {_printable(str(error))}", err=True)
        sys.exit(error.exit_code)
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what it still holds is not written at the exit
        typer.echo(
            f"terrafix: output cannot be written ({error.strerror}); free some space, or write elsewhere", err=True
        )
        sys.exit(OutputError.exit_code)
    except ModuleNotFoundError as error:
        name = error.name or ""
        extra = next((extra for extra, beginnings in EXTRAS.items() if name.startswith(beginnings)), "")
        if not extra:
            raise
        missing = "terrafix-ground" if name.startswith("terrafix") else name.split(".")[0]
        from terrafix_tools.installation import install_command

        typer.echo(f"terrafix: this command needs {missing}; install it: {install_command(extra)}", err=True)
        sys.exit(UsageError.exit_code)


if __name__ == "__main__":
    main()
