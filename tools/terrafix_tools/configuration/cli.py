"""The commands `terrafix init` and `terrafix config ...`."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import UsageError

app = typer.Typer(no_args_is_help=True, help="Configuration files: check, keys, schemas for editors.")
QUESTIONS = {
    "vehicle": "What flies? copter, plane (ArduPilot, Terrafix alone), second-gps (beside a receiver), px4",
    "camera": "Address of the camera: csi://0, /dev/video0, rtsp://...",
    "size": "Size of its images in pixels",
    "fov": "Horizontal field of view in degrees, by the data sheet of the lens",
    "link": "Connection to the autopilot: /dev/ttyTHS1, udpin:0.0.0.0:14550, ...",
}
# What Enter takes; what flies and the lens have to be known.
DEFAULTS = {"camera": "/dev/video0", "size": "1280x720", "link": "/dev/ttyTHS1"}


def init(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; a new one, or without these files.")],
    vehicle: Annotated[str, typer.Option(help="copter, plane, second-gps or px4.")] = "",
    camera: Annotated[str, typer.Option(help="Address of the camera.")] = "",
    lens: Annotated[str, typer.Option(help="Camera description of a calibration, instead of --size and --fov.")] = "",
    size: Annotated[str, typer.Option(help="WIDTHxHEIGHT of its images.")] = "",
    fov: Annotated[float, typer.Option(help="Horizontal field of view, degrees.")] = 0.0,
    map_path: Annotated[str, typer.Option("--map", help="Map package; may follow later.")] = "",
    link: Annotated[str, typer.Option(help="Connection to the autopilot.")] = "",
) -> None:
    """The files of a vehicle: configuration, camera description, parameters, checklist. Asks for what is missing."""
    from terrafix_tools.configuration.first_files import FirstAnswers, Vehicle, write_first_files
    from terrafix_tools.installation import command

    given = {"vehicle": vehicle, "camera": camera}
    if not lens:
        given |= {"size": size, "fov": f"{fov:g}" if fov else ""}
    given["link"] = link
    answers = {name: value or _ask(name) for name, value in given.items()}
    if answers["vehicle"] not in set(Vehicle):
        raise UsageError(f"--vehicle {answers['vehicle']}: choose one of {', '.join(Vehicle)}")
    files = write_first_files(
        folder,
        FirstAnswers(
            vehicle=Vehicle(answers["vehicle"]),
            camera=answers["camera"],
            link=answers["link"],
            map_path=map_path,
            lens=lens,
            size=answers.get("size", ""),
            fov_deg=_degrees(answers.get("fov", "0")),
        ),
    )
    for path in files:
        typer.echo(f"written  {path}")
    if answers["vehicle"] == Vehicle.PX4:
        typer.echo(f"next     {files[2]}")
    else:
        typer.echo(f"next     {command()} preflight --simulate {answers['vehicle']} --config {files[0]}")


def _ask(name: str) -> str:
    if not sys.stdin.isatty():
        raise UsageError(f"--{name} is missing; give it, or call 'terrafix init' in a terminal, where it asks")
    return str(typer.prompt(QUESTIONS[name], default=DEFAULTS.get(name))).strip()


def _degrees(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UsageError(f"--fov {text}: not a number; give degrees, such as 70") from None


@app.command()
def check(
    files: Annotated[list[Path], typer.Argument(help="Configurations, camera descriptions, flight.toml.")],
) -> None:
    """Whether files can be flown with: keys, bounds, files that they name. The first mistake is one line."""
    from terrafix_tools.configuration.check import check as run_check

    for file in files:
        for line in run_check(file):
            typer.echo(line)


@app.command()
def keys() -> None:
    """Every key of the configuration with its default, unit and bounds."""
    from terrafix.core.installed_files import installed_files

    typer.echo((installed_files() / "config" / "default.toml").read_text(encoding="utf-8"), nl=False)
