"""The commands `terrafix map ...`."""

from pathlib import Path
from typing import Annotated

import typer

from terrafix_tools.mapping import cli_mosaic, cli_package
from terrafix_tools.mapping.choices import Datum, Descriptors, Unit

app = typer.Typer(no_args_is_help=True, help="Make and inspect map packages.")


@app.command("build")
def map_build(
    imagery: Annotated[Path | None, typer.Argument(help="GeoTIFF or any GDAL raster; all of it, or --area.")] = None,
    *,
    out: Annotated[Path, typer.Option(help="Map package to write (.gpkg).")],
    area: Annotated[
        str,
        typer.Option(help="W,S,E,N in degrees, .kml, .kmz, .geojson, QGroundControl .plan or ArduPilot .waypoints."),
    ] = "",
    buffer: Annotated[float | None, typer.Option(help="Kilometres around the area; default 20.")] = None,
    corridor: Annotated[
        float | None, typer.Option(help="Kilometres to either side of a mission; recommended for missions.")
    ] = None,
    source: Annotated[
        list[str] | None,
        typer.Option(help="File, {z}/{x}/{y} address or sentinel-2; repeatable, the first valid pixel is used."),
    ] = None,
    sources: Annotated[Path | None, typer.Option(help="TOML file of sources, after those of --source.")] = None,
    gsd: Annotated[
        float | None,
        typer.Option(help="Requested metres per pixel: selects the zoom of tiles, downsamples finer images."),
    ] = None,
    dem: Annotated[str, typer.Option(help="Elevation raster, heights AMSL; or glo-30 (Copernicus).")] = "",
    dem_datum: Annotated[
        Datum | None, typer.Option(help="Vertical datum of --dem; default: as the file says, else egm96.")
    ] = None,
    dem_unit: Annotated[
        Unit | None, typer.Option(help="Unit of the heights of --dem; default: as the file says.")
    ] = None,
    geoid: Annotated[Path | None, typer.Option(help="Grid of the geoid EGM96, if PROJ has none.")] = None,
    osm: Annotated[str, typer.Option(help="Roads, water, buildings: an .osm.pbf, 'overpass' or its address.")] = "",
    osm_ce90: Annotated[
        float | None,
        typer.Option(min=0.0, max=200.0, help="Stated position error of --osm: radius of 90 %, metres."),
    ] = None,
    date: Annotated[str, typer.Option(help="Date of the imagery, YYYY-MM-DD.")] = "",
    licence: Annotated[str, typer.Option(help="Licence of the imagery; required for network sources.")] = "",
    ce90: Annotated[
        float | None,
        typer.Option(min=0.0, max=200.0, help="Stated position error of the imagery: radius of 90 %, metres."),
    ] = None,
    descriptors: Annotated[
        Descriptors, typer.Option(help="Precomputed descriptors for the search of the whole map.")
    ] = Descriptors.WEIGHTS_FREE,
    null_agl: Annotated[
        list[float] | None,
        typer.Option(min=30.0, help="Height of flights, m: fits a null model for it; repeatable."),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Requests per second that the servers of --source allow; default 5.")
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(min=1, max=64, help="Processes that read and encode; default: one per core, at most 8."),
    ] = None,
    scheduler: Annotated[str, typer.Option(help="tcp://host:port of a Dask cluster to use instead.")] = "",
    cache: Annotated[Path | None, typer.Option(help="Folder for downloads; default ~/.cache/terrafix.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Confirm a large download.")] = False,
    estimate: Annotated[bool, typer.Option("--estimate", help="Print what would be downloaded, and stop.")] = False,
) -> None:
    """Imagery, elevation and vectors -> map package: of a whole image, or of an area from several sources."""
    from terrafix_tools.mapping.area.build import Order, build_order

    build_order(
        Order(
            out=out,
            area=area,
            buffer_km=buffer,
            corridor_km=corridor,
            source=[*([str(imagery)] if imagery else []), *(source or [])],
            sources=sources,
            gsd_m=gsd,
            dem=dem,
            dem_datum=dem_datum,
            dem_unit=dem_unit,
            geoid=geoid,
            osm=osm,
            osm_ce90_m=osm_ce90,
            date=date,
            licence=licence,
            ce90_m=ce90,
            descriptors=descriptors,
            null_agl_m=tuple(null_agl or ()),
            rate=rate,
            workers=workers,
            scheduler=scheduler,
            cache=cache,
            agreed=yes,
            estimate_only=estimate,
        )
    )


for command in (
    cli_package.info,
    cli_package.check,
    cli_package.preview,
    cli_package.index,
    cli_package.keygen,
    cli_package.sign,
    cli_mosaic.mosaic,
):
    app.command()(command)
