"""`terrafix models export`: graphs of this program itself, which need no weights."""

import typer

from terrafix.core.errors import OutputError
from terrafix_engines.correlation import export
from terrafix_engines.store import models_folder


def export_correlation(folder: str, *, fp16: bool) -> None:
    """Raises OutputError when the models folder cannot be written."""
    where = models_folder(folder)
    try:
        paths = export(where, fp16)
    except OSError as error:
        raise OutputError(f"{where}: cannot be written ({error.strerror}); choose another --folder") from None
    for path in paths:
        typer.echo(f"written to {path}")
