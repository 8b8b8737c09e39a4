"""The models folder: fetched weights, user manifests and TensorRT engines."""

import hashlib
import os
import stat
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from terrafix_engines.manifest import SHIPPED, Manifest, ManifestError, find_manifest
from terrafix_engines.providers import PREFERENCE
from terrafix_engines.runtime import Model, ModelFileError

ENGINES = "engines"  # subfolder of the models folder


def models_folder(chosen: str = "") -> Path:
    """``chosen``, else the environment variable TERRAFIX_MODELS, else terrafix/models in XDG_DATA_HOME, which defaults
    to ~/.local/share (XDG Base Directory Specification)."""
    if folder := chosen or os.environ.get("TERRAFIX_MODELS", ""):
        return Path(folder).expanduser()
    data_home = os.environ.get("XDG_DATA_HOME", "")
    return (Path(data_home) if data_home else Path.home() / ".local" / "share") / "terrafix" / "models"


class State(StrEnum):
    READY = "ready"
    ABSENT = "not fetched"
    ALTERED = "altered"  # size or checksum differs from the manifest


@dataclass(frozen=True)
class StoredModel:
    """A model and the path of its file in the models folder; the file may be missing."""

    manifest: Manifest
    path: Path
    engines: Path

    def exists(self) -> bool:
        """Raises ModelFileError without read permission, which ``is_file`` hides since Python 3.14."""
        try:
            return stat.S_ISREG(self.path.stat().st_mode)
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError as error:
            raise ModelFileError(f"{self.path}: cannot be read ({error.strerror}); check permissions") from None

    def state(self) -> State:
        """Hashes the whole file. Raises ModelFileError when it cannot be read."""
        if not self.exists():
            return State.ABSENT
        try:
            same = self.path.stat().st_size == self.manifest.size_bytes and sha256_of(self.path) == self.manifest.sha256
        except OSError as error:
            raise ModelFileError(f"{self.path}: cannot be read ({error.strerror}); check permissions") from None
        return State.READY if same else State.ALTERED

    def open(
        self,
        inputs: tuple[str, ...],
        outputs: tuple[str, ...],
        *,
        prefer: tuple[str, ...] = PREFERENCE,
        build: bool = False,
    ) -> Model:
        """Opens it as ``Model``. Raises ModelFileError, also when the file is not the published one."""
        if not self.exists():
            raise ModelFileError(f"{self.path}: not there; terrafix models fetch {self.manifest.name}")
        return Model(
            self.path,
            inputs,
            outputs,
            manifest=self.manifest,
            engines=self.engines,
            exact=True,
            prefer=prefer,
            build=build,
        )


def stored_model(manifest: Manifest, folder: Path) -> StoredModel:
    """The weights that the program brings lie beside their manifest, others in ``folder``."""
    shipped = SHIPPED / manifest.file
    return StoredModel(manifest, shipped if shipped.is_file() else folder / manifest.file, folder / ENGINES)


def resolve_model(text: str, slot: str, folder: Path) -> StoredModel | Path:
    """Resolves a configured model: the name of a model, or the path of a file with the inputs and outputs of ``slot``.

    The role of a named model must be that of the model ``slot``. Raises ModelFileError."""
    if "/" in text or text.endswith(".onnx") or os.path.isfile(text):
        return Path(text)
    try:
        manifest = find_manifest(text, folder)
        role = find_manifest(slot, folder).role
    except ManifestError as error:
        raise ModelFileError(str(error)) from None
    if manifest.role != role:
        raise ModelFileError(f"the model '{text}' cannot be used as {slot}: its role is {manifest.role}, not {role}")
    return stored_model(manifest, folder)


def sha256_of(path: Path) -> str:
    """Hex digest of a file. Raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
