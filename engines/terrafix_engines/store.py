"""The models folder: where fetched weights, a user's manifests and the engines of TensorRT lie."""

import hashlib
import os
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from terrafix_engines.manifest import Manifest, ManifestError, named
from terrafix_engines.providers import PREFERENCE
from terrafix_engines.runtime import Model, ModelFileError

ENGINES = "engines"  # folder in the models folder
_BLOCK_BYTES = 1 << 20


def models_folder(chosen: str = "") -> Path:
    """The one that was chosen; else what TERRAFIX_MODELS says; else terrafix/models in XDG_DATA_HOME, which is
    ~/.local/share when it is not set (XDG Base Directory Specification)."""
    if folder := chosen or os.environ.get("TERRAFIX_MODELS", ""):
        return Path(folder).expanduser()
    data_home = os.environ.get("XDG_DATA_HOME", "")
    return (Path(data_home) if data_home else Path.home() / ".local" / "share") / "terrafix" / "models"


class State(StrEnum):
    READY = "ready"
    ABSENT = "not fetched"
    ALTERED = "altered"  # another size or another checksum than the manifest states


@dataclass(frozen=True)
class Stored:
    """A model and its file in the models folder, whether the file is there or not."""

    manifest: Manifest
    path: Path
    engines: Path

    def is_there(self) -> bool:
        """Raises ModelFileError when nobody may look."""
        try:
            return self.path.is_file()
        except OSError as error:
            raise ModelFileError(f"{self.path}: cannot be read ({error.strerror}); check permissions") from None

    def state(self) -> State:
        """Reads the whole file. Raises ModelFileError when that is not possible."""
        if not self.is_there():
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
        """As ``Model``. Raises ModelFileError, also for a file that is not the one that was published."""
        if not self.is_there():
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


def stored(manifest: Manifest, folder: Path) -> Stored:
    return Stored(manifest, folder / manifest.file, folder / ENGINES)


def find(text: str, slot: str, folder: Path) -> Stored | Path:
    """What ``text`` means for the place of the model ``slot``: the name of a model, or the path of a file of one's own
    that goes in and out like ``slot``. Raises ModelFileError."""
    if "/" in text or text.endswith(".onnx") or os.path.isfile(text):
        return Path(text)
    try:
        manifest = named(text, folder)
        role = named(slot, folder).role
    except ManifestError as error:
        raise ModelFileError(str(error)) from None
    if manifest.role != role:
        raise ModelFileError(f"the model '{text}' cannot be used as {slot}: its role is {manifest.role}, not {role}")
    return stored(manifest, folder)


def sha256_of(path: Path) -> str:
    """Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()
