"""The command `terrafix finalise`."""

from pathlib import Path
from typing import Annotated

import typer


def finalise(
    folder: Annotated[Path, typer.Argument(help="Output of replay or run: a folder with a flight record.")],
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """After landing: smooths the whole flight at once; writes finalised.csv and finalised.json beside the record."""
    from terrafix_tools.finalise.run import finalise as run_finalise
    from terrafix_tools.finalise.run import last_lines

    for line in last_lines(run_finalise(folder, progress=not quiet), folder):
        typer.echo(line)
