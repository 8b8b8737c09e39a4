"""`terrafix models fetch`: downloads weights into the models folder.

A partial download is NAME.part, which the next attempt resumes (HTTP range). The file gets its final name when its
checksum is correct, so that the folder never contains an incomplete model.
"""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, TextColumn, TimeRemainingColumn, TransferSpeedColumn

from terrafix.core.errors import ModelError, OutputError
from terrafix_engines.manifest import Manifest
from terrafix_engines.store import State, StoredModel, sha256_of
from terrafix_tools.models.known import select_models, state_of
from terrafix_tools.progress import LineProgress

OnBytes = Callable[[int], None]  # called with the number of bytes received so far


def fetch_all(names: list[str], source: str, folder: str) -> None:
    """Raises ModelError (unknown model, network, checksum) and OutputError (folder not writable)."""
    for model in select_models(names, folder):
        m = model.manifest
        if state_of(model) is State.READY:
            typer.echo(f"{m.name}: is there already, as published ({model.path})")
            continue
        origin = _origin(m, source)
        typer.echo(f"{m.name}: {m.title}, {m.size_bytes / 1e6:.1f} MB, licence {m.licence}")
        if m.credit:
            typer.echo(f"{m.name}: {m.credit}")
        typer.echo(f"{m.name}: from {origin}")
        try:
            _fetch(model, origin)
        except OSError as error:
            raise OutputError(f"{error.filename or model.path}: {error.strerror}; the model was not fetched") from None
        typer.echo(f"{m.name}: sha256 is right; {model.path}")


def _origin(manifest: Manifest, source: str) -> str | Path:
    """Returns a URL or an existing file. Raises ModelError."""
    if not source:
        if not manifest.source:
            raise ModelError(f"{manifest.name}: is not to be had from a network; give the file with --from")
        return manifest.source
    if source.startswith(("http://", "https://")):
        return source + manifest.file if source.endswith("/") else source
    path = Path(source).expanduser()
    path = path / manifest.file if path.is_dir() else path
    if not path.is_file():
        raise ModelError(f"{path}: no such file; --from is a file, the folder that has it, or an http(s) address")
    return path


def _fetch(model: StoredModel, origin: str | Path) -> None:
    m = model.manifest
    model.path.parent.mkdir(parents=True, exist_ok=True)
    part = model.path.with_name(model.path.name + ".part")
    with part.open("ab") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise ModelError(f"{part}: another terrafix is fetching this model; wait for it") from None
        try:
            with _bar(m) as on_progress:
                _transfer(m, origin, part, on_progress)
            found = sha256_of(part)
            if found != m.sha256:
                os.truncate(part, 0)
                raise ModelError(
                    f"{origin}: not the published file (sha256 {found[:12]}..., expected {m.sha256[:12]}...); "
                    "it was discarded, try another --from"
                )
            os.fsync(lock.fileno())
            part.replace(model.path)
        finally:
            if part.exists() and part.stat().st_size == 0:
                part.unlink()


def _transfer(manifest: Manifest, origin: str | Path, part: Path, on_progress: OnBytes) -> None:
    """Transfers from ``origin`` to ``part``. Raises ModelError and OSError."""
    if isinstance(origin, Path):
        _copy(origin, part, on_progress)
        return
    from terrafix_tools.models.download import download  # needs urllib3, which a vehicle does not have

    resumed = part.stat().st_size > 0
    download(manifest, origin, part, on_progress)
    if resumed and sha256_of(part) != manifest.sha256:  # the existing part may be of another file
        os.truncate(part, 0)
        download(manifest, origin, part, on_progress)


def _copy(origin: Path, part: Path, on_progress: OnBytes) -> None:
    """Copies a local file. Raises ModelError when it cannot be read."""
    try:
        with origin.open("rb") as file, part.open("wb") as out:
            shutil.copyfileobj(file, out)
            on_progress(out.tell())
    except PermissionError as error:
        raise ModelError(f"{error.filename}: cannot be read ({error.strerror}); check its permissions") from None


@contextmanager
def _bar(manifest: Manifest) -> Iterator[OnBytes]:
    console = Console(stderr=True)
    columns = (TextColumn(manifest.name), BarColumn(), DownloadColumn(), TransferSpeedColumn(), TimeRemainingColumn())
    with LineProgress(*columns, console=console) as progress:
        task = progress.add_task(manifest.name, total=manifest.size_bytes)
        yield lambda received: progress.update(task, completed=received)
