"""The commands `terrafix models ...`."""

import math
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Fetch, check, build and measure learned models.")

Names = Annotated[list[str] | None, typer.Argument(help="Names of models; see the default of the command.")]
Folder = Annotated[
    str, typer.Option("--folder", help="Models folder; default: TERRAFIX_MODELS, or ~/.local/share/terrafix/models.")
]


@app.command("list")
def models_list(
    folder: Folder = "", as_json: Annotated[bool, typer.Option("--json", help="JSON instead of a table.")] = False
) -> None:
    """List the known models, their state, and the providers of this computer."""
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
    """Download weights into the models folder: resumes a partial download, verifies the checksum, shows the licence."""
    from terrafix_tools.models.fetch import fetch_all

    fetch_all(names, source, folder)


@app.command()
def verify(names: Names = None, folder: Folder = "") -> None:
    """Check that models are complete, match the published checksum and run here. Default: all fetched models."""
    from terrafix_tools.models.listing import verify_all

    verify_all(names or [], folder)


@app.command()
def export(
    fp16: Annotated[bool, typer.Option("--fp16", help="Half precision: half of the memory traffic of a GPU.")] = False,
    folder: Folder = "",
) -> None:
    """Write the graphs that correlate frames with the map on a GPU ([models] correlation = "gpu")."""
    from terrafix_tools.models.build import export_correlation

    export_correlation(folder, fp16=fp16)


@app.command()
def build(names: Names = None, folder: Folder = "") -> None:
    """Build TensorRT engines, so that none is built in flight. Default: all fetched models."""
    from terrafix_tools.models.build import build_all

    build_all(names or [], folder)


@app.command()
def bench(
    names: Names = None,
    folder: Folder = "",
    out: Annotated[Path, typer.Option(help="JSON to write.")] = Path("out/models.json"),
    runs: Annotated[int, typer.Option(min=1, help="Timed runs per input size.")] = 20,
) -> None:
    """Measure run times of models next to a baseline without weights."""
    from terrafix_tools.models.bench import bench_all

    bench_all(names or [], folder, out, runs=runs)


@app.command()
def matching(
    sets: Annotated[
        Path, typer.Argument(help="TOML list of pairs of dates and flights, as config/training/judges.toml.")
    ],
    names: Annotated[list[str] | None, typer.Option("--model", help="Model to compare; repeatable.")] = None,
    folder: Folder = "",
    data: Annotated[Path, typer.Option(help="Folder that the paths of the list are relative to.")] = Path(),
    only: Annotated[list[str] | None, typer.Option("--set", help="Name of a set; repeatable. Default: all.")] = None,
    prior: Annotated[
        list[float] | None, typer.Option(help="1-sigma of the known position, m; repeatable; inf: whole map.")
    ] = None,
    unknown_heading: Annotated[bool, typer.Option(help="Also without a heading.")] = True,
    places: Annotated[int, typer.Option(min=2, help="Frames of each set.")] = 40,
    out: Annotated[Path, typer.Option(help="JSON to write.")] = Path("out/matching.json"),
) -> None:
    """Measure how often single frames are placed on a map of another date: gradients and models side by side."""
    from terrafix_tools.models.matching import measure_matching

    measure_matching(
        sets,
        data,
        names or [],
        folder,
        only=only or [],
        priors_m=prior or [100.0, 300.0, 1000.0, math.inf],
        unknown_heading=unknown_heading,
        places=places,
        out=out,
    )
