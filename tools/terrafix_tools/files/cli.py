"""The command `terrafix files`."""

from pathlib import Path
from typing import Annotated

import typer


def files(
    out: Annotated[Path | None, typer.Argument(help="Folder for copies; without it the files are listed.")] = None,
) -> None:
    """Configuration, camera descriptions, autopilot parameters and the systemd unit that come with Terrafix."""
    from terrafix_tools.files.copy import copied, listed

    for path in listed() if out is None else copied(out):
        typer.echo(path)
