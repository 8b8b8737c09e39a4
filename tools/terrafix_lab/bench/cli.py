"""The command `terrafix bench`."""

from pathlib import Path
from typing import Annotated

import typer


def bench(
    data: Annotated[Path, typer.Option(help="Folder with flights/ and models/.")] = Path("../shared/data"),
    out: Annotated[Path, typer.Option(help="JSON to write.")] = Path("out/bench.json"),
    flight: Annotated[
        list[str] | None, typer.Option(help="Name in flights/, or 'generated'; may be given several times.")
    ] = None,
    frames: Annotated[int | None, typer.Option(help="Use at most this many frames of each flight.")] = None,
    xfeat: Annotated[bool, typer.Option(help="Also run with XFeat, when models/xfeat.onnx exists.")] = True,
    growing: Annotated[bool, typer.Option(help="Also run larger maps (to 100 km2) and longer flights.")] = True,
    page: Annotated[Path | None, typer.Option(help="Markdown page to write, with a picture in images/.")] = None,
) -> None:
    """Measure time, memory and accuracy next to baselines of the same run, and how they scale."""
    from terrafix_lab.bench.run import bench as run_bench

    run_bench(data, out, flights=flight, frames=frames, xfeat=xfeat, growing=growing, page=page)
