"""The command `terrafix status`."""

import contextlib
from typing import Annotated

import typer


def status(
    once: Annotated[bool, typer.Option("--once", help="Print it once and exit, also without a terminal.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print it once as JSON.")] = False,
    run: Annotated[str, typer.Option(help="Run folder, when several run on this computer.")] = "",
) -> None:
    """What the Terrafix process on this computer does: position and why, autopilot, processes, rates, heat, losses.

    It reads the bus and publishes nothing. Ctrl-C ends it."""
    from rich.console import Console

    from terrafix_tools.run_choice import chosen_run
    from terrafix_tools.status.watch import print_once, watch

    found, console = chosen_run(run), Console()
    if once or as_json or not console.is_terminal:
        print_once(found, console, as_json=as_json)
        return
    with contextlib.suppress(KeyboardInterrupt):
        watch(found, console)
