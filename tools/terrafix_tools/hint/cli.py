"""The command `terrafix hint`."""

from typing import Annotated

import typer


def hint(
    latitude: Annotated[float, typer.Argument(help="Degrees, north positive.")],
    longitude: Annotated[float, typer.Argument(help="Degrees, east positive.")],
    radius: Annotated[float, typer.Option(help="Radius in metres that contains the vehicle.")] = 5000.0,
    run: Annotated[str, typer.Option(help="Run folder, when several run on this computer.")] = "",
) -> None:
    """Send an approximate position to the Terrafix process on this computer. The search uses it; the map decides."""
    from terrafix_tools.hint.send import hint as send

    typer.echo(send(latitude, longitude, radius, run))


# Lets negative degrees pass as arguments.
CONTEXT = {"ignore_unknown_options": True}
