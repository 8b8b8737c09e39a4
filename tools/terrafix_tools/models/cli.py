"""The commands `terrafix models ...`."""

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Fetch, check, build and measure learned models.")

Names = Annotated[list[str] | None, typer.Argument(help="Names of models; default: all that are meant.")]
Folder = Annotated[
    str, typer.Option("--folder", help="Models folder; default: TERRAFIX_MODELS, or ~/.local/share/terrafix/models.")
]


@app.command("list")
def models_list(
    folder: Folder = "", as_json: Annotated[bool, typer.Option("--json", help="JSON instead of a table.")] = False
) -> None:
    """What is known, what is there, and which providers this computer has."""
    from terrafix_tools.models.listing import show

    show(folder, as_json=as_json)


@app.command()
def fetch(
    names: Annotated[list[str], typer.Argument(help="Names of models (terrafix models list).")],
    source: Annotated[
        str, typer.Option("--from", help="File, folder or http(s) address instead of the published one.")
    ] = "",
    folder: Folder = "",
) -> None:
    """Bring weights into the models folder: goes on where it was cut off, checks the checksum, shows the licence."""
    from terrafix_tools.models.fetch import fetch_all

    fetch_all(names, source, folder)


@app.command()
def verify(names: Names = None, folder: Folder = "") -> None:
    """Whole, as published, and does it run here? Default: all models that were fetched."""
    from terrafix_tools.models.listing import verify_all

    verify_all(names or [], folder)


@app.command()
def build(names: Names = None, folder: Folder = "") -> None:
    """Build the engines of TensorRT, so that none is built in flight. Default: all models that were fetched."""
    from terrafix_tools.models.build import build_all

    build_all(names or [], folder)


@app.command()
def bench(
    names: Names = None,
    folder: Folder = "",
    out: Annotated[Path, typer.Option(help="JSON to write.")] = Path("out/models.json"),
    runs: Annotated[int, typer.Option(min=1, help="Answers that are timed, for each size.")] = 20,
    pair: Annotated[
        tuple[Path, Path] | None,
        typer.Option(
            help="Two images of one place at two dates: how often is a patch of the first found on the second?"
        ),
    ] = None,
    trials: Annotated[int, typer.Option(min=1, help="Places that are tried on the pair.")] = 40,
) -> None:
    """Time of every model beside what needs no weights, and with --pair how well features find a place."""
    from terrafix_tools.models.bench import bench_all

    bench_all(names or [], folder, out, runs=runs, pair=pair, trials=trials)
