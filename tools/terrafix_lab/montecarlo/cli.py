"""The command `terrafix montecarlo`."""

from pathlib import Path
from typing import Annotated

import typer

BROKEN_FLOOR = 1  # exit code


def montecarlo(
    out: Annotated[Path, typer.Option(help="Folder for montecarlo.json and montecarlo.png.")] = Path("out/montecarlo"),
    flights: Annotated[int, typer.Option(help="Number of flights.")] = 100,
    first: Annotated[int, typer.Option(help="Number of the first flight: --first 17 --flights 1 flies that one.")] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of all random draws.")] = 1,
    duration: Annotated[float, typer.Option(help="Seconds of every flight.")] = 600.0,
    fault: Annotated[
        str | None, typer.Option(help="This fault in every flight, instead of the usual sequence.")
    ] = None,
    lies: Annotated[
        float,
        typer.Option(help="Probability of each false input in a flight, in addition to its fault; 0.05 is usual."),
    ] = 0.0,
    workers: Annotated[int | None, typer.Option(help="Processes; default: one for each processor.")] = None,
) -> None:
    """Many simulated flights, as messages, through the real estimator: tests its accuracy and consistency.

    Exit code 0: all floors hold, or the flights are too few to judge one; 1: one does not hold."""
    from terrafix_lab.montecarlo.run import RunOptions, fault_of
    from terrafix_lab.montecarlo.run import montecarlo as run

    options = RunOptions(out, flights, first, seed, duration, fault and fault_of(fault), lies, workers)
    result = run(options)
    typer.echo(f"Written to {out}")
    raise typer.Exit(BROKEN_FLOOR if False in result["floors"].values() else 0)
