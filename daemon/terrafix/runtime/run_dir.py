"""The folder in shared memory through which the processes of one run meet: sockets, frames, progress, what to run.

It exists as long as its supervisor: a lock tells a living folder from one that a killed supervisor left behind. Who is
started in the place of one that was killed in flight goes on from what lies there."""

import fcntl
import os
import shutil
import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import msgspec

from terrafix.core.clock import now_ns
from terrafix.runtime.progress_stamp import Progress

T = TypeVar("T")
SHM = Path("/dev/shm")  # memory, not disk: frames and progress stamps never wait for storage
PREFIX = "terrafix-"
SAME_FLIGHT_NS = 60_000_000_000  # a run that lived so lately was killed in the flight that goes on now


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

    def gave_up(self, process: str) -> Path:
        """It is there when ``process`` will not be started again."""
        return self.path / f"{process}.gave_up"

    def checkpoint(self, process: str) -> Path:
        """What ``process`` leaves to the one that is started in its place."""
        return self.path / f"{process}.checkpoint"

    def shelf(self, process: str) -> Path:
        """Folder of what ``process`` can compute anew, but not at once."""
        return self.path / f"{process}.shelf"

    @property
    def frames(self) -> Path:
        return self.path / "frames"

    @property
    def spec(self) -> Path:
        return self.path / "spec.json"

    @property
    def epoch_ns(self) -> int | None:
        """``t_ns`` of the first Origin of this run: a source that is opened again goes on on the same time."""
        return int(self._epoch.read_text()) if self._epoch.exists() else None

    def set_epoch(self, t_ns: int) -> None:
        """The first one counts."""
        if not self._epoch.exists():
            write_whole(self._epoch, str(t_ns).encode())

    @property
    def _epoch(self) -> Path:
        return self.path / "epoch_ns"

    def goes_on_from(self, dead: "RunDir") -> bool:
        """What the processes of ``dead`` knew last. False: they were not run for the same, or have not lived until just
        now."""
        same = dead.spec.is_file() and dead.spec.read_bytes() == self.spec.read_bytes()
        if not same or not dead.flew_just_now():
            return False
        for file in (dead._epoch, *dead.path.glob("*.checkpoint")):
            write_whole(self.path / file.name, file.read_bytes())
        for folder in dead.path.glob("*.shelf"):
            with suppress(OSError):  # it can be done without
                folder.rename(self.path / folder.name)
        return True

    def flew_just_now(self) -> bool:
        """Its source was open, and it lived until just now."""
        return self._epoch.exists() and now_ns() - self._lived_ns() <= SAME_FLIGHT_NS

    def _lived_ns(self) -> int:
        """The newest stamp of any of its processes; 0: none has one."""
        newest_ns = 0
        for file in self.path.glob("*.progress"):
            progress = Progress(file)
            newest_ns = max(newest_ns, progress.stamp_ns)
            progress.close()
        return newest_ns


def write_whole(file: Path, data: bytes) -> None:
    """Whole or not at all, also when this process is killed right now."""
    fresh = file.with_suffix(".new")
    fresh.write_bytes(data)
    fresh.replace(file)


def save(file: Path, data: bytes) -> None:
    """For the process that is started in the place of this one. Where memory is full it finds what was left before: no
    process dies in flight for what the next one would like to know."""
    with suppress(OSError):
        write_whole(file, data)


def load(file: Path | None, decode: Callable[[bytes], T]) -> T | None:
    """What a process left there; None: nothing, or nothing that can be read, and this one begins without."""
    if file is None:
        return None
    try:
        return decode(file.read_bytes())
    except (OSError, msgspec.DecodeError):
        return None


class OwnedRunDir:
    """The supervisor's view: made, locked, and removed by it, unless it is ``load`` to the one that is started next."""

    left = False

    def __init__(self, parent: Path | None = None, spec: bytes = b"", *, goes_on: bool = False) -> None:
        """``spec``: what to run. ``goes_on``: from where a run of the same was killed, if that was just now."""
        parent = parent or _default_parent()
        self.run_dir = RunDir(Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent)))
        # An exclusive lock dies with its holder, however that dies.
        self._lock_fd = os.open(self.run_dir.path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._lock_fd, fcntl.LOCK_EX)
        self.run_dir.spec.write_bytes(spec)
        sweep(parent, self.run_dir if goes_on else None)

    def remove(self) -> None:
        if not self.left:
            shutil.rmtree(self.run_dir.path, ignore_errors=True)
        os.close(self._lock_fd)


def _default_parent() -> Path:
    return SHM if os.access(SHM, os.W_OK) else Path(tempfile.gettempdir())


def living(parent: Path | None = None) -> list[RunDir]:
    """The folders of supervisors that live. Another user's cannot be looked into, and counts as living."""
    folders = _folders(parent)
    return [RunDir(folder) for folder in folders if not os.access(folder, os.X_OK) or _is_held(folder / "lock")]


def killed_in_flight(parent: Path | None = None) -> list[RunDir]:
    """Whose supervisor is gone, in the flight that goes on now; this user's."""
    seen = (folder for folder in _folders(parent) if os.access(folder, os.X_OK))
    dead = (RunDir(folder) for folder in seen if not _is_held(folder / "lock"))
    return [run for run in dead if run.flew_just_now()]


def _folders(parent: Path | None) -> list[Path]:
    return sorted((parent or _default_parent()).glob(f"{PREFIX}*"))


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


def sweep(parent: Path, heir: RunDir | None = None) -> None:
    """Removes the folders of supervisors that are gone, when ``heir`` has taken from them what goes on. Of another run
    that was killed in flight just now the heir is still to come."""
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
            dead = RunDir(lock.parent)
            if (heir is not None and heir.goes_on_from(dead)) or not dead.flew_just_now():
                shutil.rmtree(lock.parent, ignore_errors=True)
        finally:
            os.close(fd)
