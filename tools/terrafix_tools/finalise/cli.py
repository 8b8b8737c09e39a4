"""The command `terrafix finalise`."""

from pathlib import Path
from typing import Annotated

import typer


def finalise(
    folder: Annotated[Path, typer.Argument(help="Output of replay or run: a folder with a flight record.")],
    quiet: Annotated[bool, typer.Option(help="No progress bar.")] = False,
) -> None:
    """After landing: smooths the whole flight at once; writes finalised.csv and finalised.json beside the record."""
    from rich.console import Console

    from terrafix_tools.before_after import table
    from terrafix_tools.finalise.run import bar, last_lines
    from terrafix_tools.finalise.run import finalise as run_finalise

    with bar(not quiet) as step:
        summary = run_finalise(folder, step)
    for flight in summary["flights"]:
        if flight["before_after"]:
            Console().print(table(flight["before_after"]))
    for line in last_lines(summary, folder):
        typer.echo(line)
