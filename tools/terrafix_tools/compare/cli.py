"""The command `terrafix compare`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from terrafix.core.errors import OutputError

DIFFERENT = 1  # exit code


def compare(
    a: Annotated[Path, typer.Argument(help="Record, or folder of replay or run.")],
    b: Annotated[Path, typer.Argument(help="Another record of the same flight.")],
    json_only: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
    html: Annotated[Path | None, typer.Option(help="Also write an HTML page.")] = None,
) -> None:
    """Compare two records of one flight: where they first diverge, positions, verdicts, timing. Exit code 1: they
    differ."""
    from terrafix_tools.compare.alignment import read_record
    from terrafix_tools.compare.difference import compare_records, distances_m
    from terrafix_tools.compare.page import page
    from terrafix_tools.compare.text import summary

    record_a, record_b = read_record(a), read_record(b)
    comparison = compare_records(record_a, record_b)
    if html is not None:
        try:
            html.write_text(page(comparison, distances_m(record_a, record_b)), encoding="utf-8")
        except OSError as error:
            raise OutputError(f"{html}: cannot be written ({error.strerror}); choose another file") from None
    if json_only:
        typer.echo(json.dumps(comparison, indent=2))
    else:
        for line in summary(comparison):
            typer.echo(line)
    if not comparison["equal"]:
        raise typer.Exit(DIFFERENT)
