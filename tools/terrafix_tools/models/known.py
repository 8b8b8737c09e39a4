"""Models by name, for all commands; converts errors of the engines to errors of the command line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrafix.core.errors import ModelError
from terrafix_engines.manifest import ManifestError, read_all
from terrafix_engines.runtime import ModelFileError, ModelRunError
from terrafix_engines.store import State, StoredModel, models_folder, stored_model


@contextmanager
def as_model_errors() -> Iterator[None]:
    """Raises ModelError in place of the errors of terrafix_engines."""
    try:
        yield
    except (ManifestError, ModelFileError, ModelRunError) as error:
        raise ModelError(str(error)) from None


def select_models(names: list[str], folder: str) -> list[StoredModel]:
    """Returns the models with these names, or all known ones. Raises ModelError."""
    where = models_folder(folder)
    _readable(where)
    with as_model_errors():
        known = read_all(where)
    for name in names:
        if name not in known:
            raise ModelError(f"no model is called '{name}'; known: {', '.join(known)} (terrafix models list)")
    return [stored_model(known[name], where) for name in names or known]


def fetched_models(names: list[str], folder: str) -> list[StoredModel]:
    """Returns the models with these names, or all whose file exists. Raises ModelError."""
    models = select_models(names, folder)
    if names:
        return models
    with as_model_errors():
        return [model for model in models if model.exists()]


def state_of(model: StoredModel) -> State:
    """Returns the state of the model file. Raises ModelError."""
    with as_model_errors():
        return model.state()


def _readable(folder: Path) -> None:
    try:
        try:
            folder.stat()  # exists() hides a lack of permission since Python 3.14
        except (FileNotFoundError, NotADirectoryError):
            return
        next(folder.iterdir(), None)
    except OSError as error:
        raise ModelError(f"{folder}: cannot be read ({error.strerror}); choose another --folder") from None
