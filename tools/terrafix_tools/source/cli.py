"""`terrafix source ...`: what a source of frames is, before it is flown or replayed."""

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(no_args_is_help=True, help="Flight folders, photos, videos, cameras: what is read from them.")


@app.callback()
def options() -> None:
    """Flight folders, photos, videos, cameras: what is read from them."""


@app.command()
def info(
    source: Annotated[str, typer.Argument(help="Flight folder, photos, video, camera: docs/camera.md.")],
    start: Annotated[str, typer.Option("--start", help="LAT,LON in degrees where the flight starts.")] = "",
    config: Annotated[list[Path] | None, typer.Option("--config", help="TOML file; its [source] is used.")] = None,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Camera, lens, start, clock, rate and gaps, vehicles heard: where each comes from, and what is left out and
    why."""
    from terrafix.core.config import load
    from terrafix.core.passwords import without_password
    from terrafix.vision.sources import open_configured, parse_start
    from terrafix.vision.sources.facts import facts_of
    from terrafix_tools.source.text import fact_lines

    opened = open_configured(load(config or []).source, source, parse_start(start))
    facts = facts_of(opened)
    opened.close()
    if json_only:
        typer.echo(
            json.dumps({"source": without_password(source), "facts": [fact._asdict() for fact in facts]}, indent=2)
        )
        return
    for line in fact_lines(opened.name(), facts):
        typer.echo(line)
