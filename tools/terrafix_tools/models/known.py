"""Models by name, for all commands; what the engines say becomes an error of the command line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrafix.core.errors import ModelError
from terrafix_engines.manifest import ManifestError, known
from terrafix_engines.runtime import ModelFileError, ModelRunError
from terrafix_engines.store import State, Stored, models_folder, stored


@contextmanager
def plain_errors() -> Iterator[None]:
    """Raises ModelError for what the engines raise."""
    try:
        yield
    except (ManifestError, ModelFileError, ModelRunError) as error:
        raise ModelError(str(error)) from None


def chosen(names: list[str], folder: str) -> list[Stored]:
    """Those with these names, or all that are known. Raises ModelError."""
    where = models_folder(folder)
    _readable(where)
    with plain_errors():
        every = known(where)
    for name in names:
        if name not in every:
            raise ModelError(f"no model is called '{name}'; known: {', '.join(every)} (terrafix models list)")
    return [stored(every[name], where) for name in names or every]


def fetched(names: list[str], folder: str) -> list[Stored]:
    """Those with these names, or all whose file is there. Raises ModelError when there is none."""
    models = chosen(names, folder)
    if names:
        return models
    with plain_errors():
        there = [model for model in models if model.is_there()]
    if not there:
        raise ModelError(f"{models_folder(folder)}: no model is there yet; terrafix models fetch NAME")
    return there


def state_of(model: Stored) -> State:
    """Raises ModelError."""
    with plain_errors():
        return model.state()


def _readable(folder: Path) -> None:
    try:
        if folder.exists():
            next(folder.iterdir(), None)
    except OSError as error:
        raise ModelError(f"{folder}: cannot be read ({error.strerror}); choose another --folder") from None
