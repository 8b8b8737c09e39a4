"""The command `terrafix demo`."""

from pathlib import Path
from typing import Annotated

import typer


def demo(
    out: Annotated[Path, typer.Option(help="Folder for all output of the demo.")] = Path("out/demo"),
    seed: Annotated[int, typer.Option(help="Seed of the world and of the noise.")] = 1,
    duration: Annotated[float, typer.Option(help="Seconds of flight.")] = 90.0,
    console: Annotated[
        bool, typer.Option("--console", help="Show the flight live in the browser; Ctrl-C ends the console.")
    ] = False,
) -> None:
    """Fly over a generated world with the real processes and a simulated autopilot, and write a report."""
    from terrafix_lab.sim.demo.command import demo as run_demo

    raise typer.Exit(run_demo(out, seed=seed, duration_s=duration, with_console=console))
