"""The command `terrafix hint`."""

from typing import Annotated

import typer


def hint(
    latitude: Annotated[float, typer.Argument(help="Degrees, north positive.")],
    longitude: Annotated[float, typer.Argument(help="Degrees, east positive.")],
    radius: Annotated[float, typer.Option(help="Metres within which the vehicle certainly is.")] = 5000.0,
    run: Annotated[str, typer.Option(help="Folder of the run, when several fly on this computer.")] = "",
) -> None:
    """Tell the Terrafix that flies on this computer where it is, roughly. It searches there; it believes the map."""
    from terrafix_tools.hint.send import hint as send

    typer.echo(send(latitude, longitude, radius, run))


# Negative degrees are not options.
CONTEXT = {"ignore_unknown_options": True}
