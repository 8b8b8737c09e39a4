"""The command `terrafix map mosaic`."""

from pathlib import Path
from typing import Annotated

import typer


def mosaic(
    record: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    out: Annotated[Path, typer.Argument(help="GeoTIFF to write (cloud-optimised).")],
    frames: Annotated[
        Path | None, typer.Option(help="Flight folder, photos or video with its frames; default: the record's.")
    ] = None,
    map_path: Annotated[
        Path | None, typer.Option("--map", help="Map package with the elevation; default: the flight's.")
    ] = None,
    gsd: Annotated[float | None, typer.Option(min=0.01, help="Metres per pixel; default: that of the frames.")] = None,
    sigma: Annotated[
        float, typer.Option(min=0.1, help="Largest stated 1-sigma of the position of a frame that is used, metres.")
    ] = 10.0,
    date: Annotated[str, typer.Option(help="YYYY-MM-DD; default: by the clock of the flight.")] = "",
    flown_by: Annotated[str, typer.Option(help="Who has flown it, for the metadata.")] = "",
) -> None:
    """The frames of a flight as an orthomosaic, a newer layer for `terrafix map build`."""
    from terrafix_tools.mapping.orthomosaic.make import OrthomosaicRequest, make

    wanted = OrthomosaicRequest(record, out, frames, map_path, gsd, sigma, date, flown_by)
    made = make(wanted, progress=True)
    typer.echo(
        f"{made.frames} frames, {made.covered_m2 / 1e6:.3f} km2 at {made.gsd_m:.2f} m a pixel, CE90 "
        f"{made.statement.ce90_m:.1f} m, {made.statement.date or 'date unknown'}; written to {out}"
    )
