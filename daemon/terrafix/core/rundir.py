"""The folder in shared memory through which the processes of one run meet: sockets, frames, progress, what to run.

It exists as long as its supervisor: a lock tells a living folder from one that a killed supervisor left behind."""

import fcntl
import os
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

SHM = Path("/dev/shm")  # memory, not disk: frames and progress stamps never wait for storage
PREFIX = "terrafix-"


@dataclass(frozen=True)
class RunDir:
    path: Path

    def address(self, process: str) -> str:
        """Where ``process`` publishes."""
        return f"ipc://{self.path / process}.ipc"

    def progress(self, process: str) -> Path:
        return self.path / f"{process}.progress"

    def mistake(self, process: str) -> Path:
        """Why ``process`` ended, when that is something the user can mend: one line."""
        return self.path / f"{process}.mistake"

    def kept(self, process: str) -> Path:
        """What ``process`` leaves to the one that is started in its place."""
        return self.path / f"{process}.kept"

    @property
    def frames(self) -> Path:
        return self.path / "frames"

    @property
    def spec(self) -> Path:
        return self.path / "spec.json"

    @property
    def epoch_ns(self) -> int | None:
        """``t_ns`` of the first Origin of this run: a source that is opened again goes on on the same time."""
        file = self.path / "epoch_ns"
        return int(file.read_text()) if file.exists() else None

    def set_epoch(self, t_ns: int) -> None:
        """The first one counts."""
        file = self.path / "epoch_ns"
        if not file.exists():
            write_whole(file, str(t_ns).encode())


def write_whole(file: Path, data: bytes) -> None:
    """Whole or not at all, also when this process is killed right now."""
    fresh = file.with_suffix(".new")
    fresh.write_bytes(data)
    fresh.replace(file)


class OwnedRunDir:
    """The supervisor's view: made, locked, and removed by it."""

    def __init__(self, parent: Path | None = None) -> None:
        parent = parent or _default_parent()
        sweep(parent)
        self.run_dir = RunDir(Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent)))
        # An exclusive lock dies with its holder, however that dies.
        self._lock_fd = os.open(self.run_dir.path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock_fd, fcntl.LOCK_EX)

    def remove(self) -> None:
        shutil.rmtree(self.run_dir.path, ignore_errors=True)
        os.close(self._lock_fd)


def _default_parent() -> Path:
    return SHM if os.access(SHM, os.W_OK) else Path(tempfile.gettempdir())


def living(parent: Path | None = None) -> list[RunDir]:
    """The folders of supervisors that live. Another user's cannot be looked into, and counts as living."""
    folders = sorted((parent or _default_parent()).glob(f"{PREFIX}*"))
    return [RunDir(folder) for folder in folders if not os.access(folder, os.X_OK) or _is_held(folder / "lock")]


def _is_held(lock: Path) -> bool:
    try:
        fd = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False  # gone meanwhile
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def sweep(parent: Path) -> None:
    """Removes the folders of supervisors that are gone."""
    for lock in parent.glob(f"{PREFIX}*/lock"):
        try:
            fd = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            continue  # somebody else's, or gone meanwhile
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue  # alive
        else:
            shutil.rmtree(lock.parent, ignore_errors=True)
        finally:
            os.close(fd)
