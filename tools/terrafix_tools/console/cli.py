"""The command `terrafix serve`."""

from pathlib import Path
from typing import Annotated

import typer


def serve(
    data: Annotated[Path, typer.Option(help="Folder for flights, maps and the database.")] = Path("out/console"),
    port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port.")] = 8700,
    host: Annotated[
        str, typer.Option(help="Address; others than loopback need --tokens, --cert and --key.")
    ] = "127.0.0.1",
    maps: Annotated[list[Path] | None, typer.Option(help="Folder with map packages; repeatable.")] = None,
    sources: Annotated[Path | None, typer.Option(help="TOML file of map sources, for flights with an area.")] = None,
    tokens: Annotated[Path | None, typer.Option(help="TOML file of tokens and roles, mode 0600.")] = None,
    cert: Annotated[Path | None, typer.Option(help="TLS certificate (PEM).")] = None,
    key: Annotated[Path | None, typer.Option(help="Key of the certificate (PEM).")] = None,
    name: Annotated[list[str] | None, typer.Option(help="Further name of this service in requests.")] = None,
    bus: Annotated[str, typer.Option(help="Run folder of a live Terrafix; 'auto': the only one.")] = "",
    workers: Annotated[int, typer.Option(min=0, max=64, help="Flights that are computed at once.")] = 2,
    scheduler: Annotated[str, typer.Option(help="tcp://host:port of a Dask cluster that computes them instead.")] = "",
    model: Annotated[list[str] | None, typer.Option(help="Name of a fetched model (xfeat), or NAME=PATH.")] = None,
    config: Annotated[list[Path] | None, typer.Option(help="TOML file; may be given several times.")] = None,
) -> None:
    """The console: flights over HTTP with events, and a page. Ctrl-C ends it in order."""
    from terrafix_tools.console.serve import serve as run
    from terrafix_tools.console.settings import Settings

    run(
        Settings(
            data=data.absolute(),
            host=host,
            port=port,
            maps=tuple(path.absolute() for path in maps or ()),
            sources=sources,
            bus=bus or None,
            tokens=tokens,
            cert=cert,
            key=key,
            hosts=tuple(name or ()),
            workers=workers,
            scheduler=scheduler,
            configs=tuple(config or ()),
            models=tuple(model or ()),
        )
    )
