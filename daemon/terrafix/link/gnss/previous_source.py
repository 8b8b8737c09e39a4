"""What the autopilot navigated by before it was switched to our position: saved on disk until it is restored."""

from contextlib import suppress
from pathlib import Path

import msgspec

from terrafix.core import logs
from terrafix.core.state_folder import flush_to_disk
from terrafix.runtime.checkpoint import CheckpointFile

FILE_NAME = "position-source.json"


class PreviousSource(msgspec.Struct, frozen=True):
    """What the autopilot ``sysid`` navigated by before the switch: its parameters, or its EKF source set."""

    sysid: int
    parameters: dict[str, float] = {}
    source_set: int | None = None


class PreviousSourceFile:
    """The PreviousSource of a switch that is not undone, in ``folder``; ``folder`` None: nothing is saved."""

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / FILE_NAME
        self._file = CheckpointFile(self._path, PreviousSource, "json")

    def load(self) -> PreviousSource | None:
        return self._file.load()

    def save(self, previous: PreviousSource) -> None:
        """Returns when the file is on the disk. A disk that cannot be written is logged: without Terrafix in the air a
        spoofed vehicle is worse off than with a parameter to be restored by hand."""
        if self._path is None:
            return
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._file.save(previous)
            for path in (self._path, self._path.parent):
                flush_to_disk(path)
        except OSError as error:
            todo = "after a crash, run terrafix preflight --restore"
            logs.get().warning("position source not saved", file=str(self._path), reason=str(error), todo=todo)

    def remove(self) -> None:
        with suppress(OSError):
            self._file.remove()
