"""The command `terrafix preflight`."""

from contextlib import nullcontext
from pathlib import Path
from typing import Annotated, Any

import typer

from terrafix.core.errors import UsageError


def preflight(
    link: Annotated[str, typer.Option(help="Autopilot: udpin:H:P, udpout:H:P, tcp:H:P or a serial device.")] = "",
    map_path: Annotated[Path | None, typer.Option("--map", help="Map package.")] = None,
    mission: Annotated[
        Path | None, typer.Option(help="QGroundControl plan or waypoint file. Default: the mission on board.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the flight records and of the previous parameters.")] = Path(
        "out"
    ),
    write: Annotated[bool, typer.Option("--write", help="Set wrong parameters, after confirmation.")] = False,
    restore: Annotated[
        bool, typer.Option("--restore", help="Set the source of position back that a flight has changed.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Skip the confirmation.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
    autopilot_only: Annotated[bool, typer.Option("--autopilot-only", help="Skip map, camera and computer.")] = False,
    simulate: Annotated[
        str,
        typer.Option(help="Practise with a simulated copter, plane or second-gps; one of its parameters is wrong."),
    ] = "",
    config: Annotated[
        list[Path] | None, typer.Option("--config", help="TOML file; may be given several times.")
    ] = None,
) -> None:
    """Check autopilot, map, camera and clocks before take-off. Exit code 1: a check failed."""
    from terrafix_tools.preflight.run import preflight as run_preflight

    with _practice(simulate, link, config or []) if simulate else nullcontext() as practice:
        ready = run_preflight(
            config or [],
            link=practice.device if practice else link,
            map_path=map_path,
            mission=mission,
            out=out,
            write=write,
            restore=restore,
            yes=yes,
            as_json=as_json,
            with_computer=not (autopilot_only or practice),
        )
        if practice and not as_json:
            typer.echo(
                f"\nFound: it was {practice.wrong}."
                if practice.is_found
                else "\nThe line that is not ok has the parameter and what to do; with --write preflight sets it."
            )
    raise typer.Exit(0 if ready else 1)


def _practice(vehicle: str, link: str, configs: list[Path]) -> Any:
    """The simulated autopilot. Raises UsageError: there is another; ConfigError."""
    from terrafix.core.config import load
    from terrafix_tools.preflight.practice import Practice

    if link:
        raise UsageError("--simulate brings its own autopilot; omit --link")
    load(configs)
    practice = Practice(vehicle)
    typer.echo(f"A simulated {practice.about} 4.6, on the ground. One of its parameters is wrong: find it.\n", err=True)
    return practice
