"""Entry of the programs outside the command line `terrafix`: ``python -m terrafix_tools.NAME``."""

import sys
from collections.abc import Callable
from typing import Any

import typer

from terrafix.core.errors import TerrafixError


def run_standalone(name: str, command: Callable[..., Any]) -> None:
    """Runs ``command`` with the arguments of this process. A TerrafixError ends with one line after ``name`` and its
    exit code.
    """
    try:
        typer.run(command)
    except TerrafixError as error:
        typer.echo(f"{name}: {error}", err=True)
        sys.exit(error.exit_code)
