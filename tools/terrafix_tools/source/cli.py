"""`terrafix source ...`: what a source of frames is, before it is flown or replayed."""

import json
from pathlib import Path
from typing import Annotated

import typer

ConfigOption = Annotated[list[Path] | None, typer.Option("--config", help="TOML file; its [source] is used.")]
TopicOption = Annotated[list[str] | None, typer.Option("--topic", help="KIND=TOPIC of a ROS bag.")]

app = typer.Typer(no_args_is_help=True, help="Flight folders, photos, videos, cameras: what is read from them.")


@app.callback()
def options() -> None:
    """Flight folders, photos, videos, cameras: what is read from them."""


@app.command()
def info(
    source: Annotated[str, typer.Argument(help="Flight folder, photos, video, camera: docs/camera.md.")],
    start: Annotated[str, typer.Option("--start", help="LAT,LON in degrees where the flight starts.")] = "",
    config: ConfigOption = None,
    topic: TopicOption = None,
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Camera, lens, start, clock, rate and gaps, vehicles heard: where each comes from, and what is left out and
    why."""
    from terrafix.core.config import load
    from terrafix.core.passwords import without_password
    from terrafix.vision.sources import open_configured, parse_start, parse_topics
    from terrafix.vision.sources.facts import facts_of
    from terrafix_tools.source.text import fact_lines

    opened = open_configured(load(config or []).source, source, parse_start(start), parse_topics(topic or []))
    facts = facts_of(opened)
    opened.close()
    if json_only:
        typer.echo(
            json.dumps({"source": without_password(source), "facts": [fact._asdict() for fact in facts]}, indent=2)
        )
        return
    for line in fact_lines(opened.name(), facts):
        typer.echo(line)


@app.command()
def truth(
    source: Annotated[str, typer.Argument(help="A recording with positions: a ROS bag.")],
    out: Annotated[Path, typer.Option(help="Table for `terrafix evaluate --truth`.")],
    config: ConfigOption = None,
    topic: TopicOption = None,
) -> None:
    """The positions that a recording has, at the times of its frames: for the evaluation, the flight does not read
    them."""
    from terrafix.core.config import load
    from terrafix.core.errors import OutputError
    from terrafix.vision.sources import open_configured, parse_topics
    from terrafix.vision.sources.contract import truth_of

    opened = open_configured(load(config or []).source, source, None, parse_topics(topic or []))
    rows = [f"{file},{lat_deg:.9f},{lon_deg:.9f}\n" for file, lat_deg, lon_deg in truth_of(opened)]
    opened.close()
    try:
        out.write_text("file,lat_deg,lon_deg\n" + "".join(rows), encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror}); check the folder") from None
    typer.echo(f"{len(rows)} positions in {out}")
