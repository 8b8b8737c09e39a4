"""The command `terrafix preflight`."""

from pathlib import Path
from typing import Annotated

import typer


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
    config: Annotated[
        list[Path] | None, typer.Option("--config", help="TOML file; may be given several times.")
    ] = None,
) -> None:
    """Check autopilot, map, camera and clocks before take-off. Exit code 1: a check failed."""
    from terrafix_tools.preflight.run import preflight as run_preflight

    ready = run_preflight(
        config or [],
        link=link,
        map_path=map_path,
        mission=mission,
        out=out,
        write=write,
        restore=restore,
        yes=yes,
        as_json=as_json,
        with_computer=not autopilot_only,
    )
    raise typer.Exit(0 if ready else 1)
