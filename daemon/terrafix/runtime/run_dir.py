"""The run folder: a folder in shared memory with the sockets, frames, progress stamps, checkpoints and spec of a run.

It exists as long as its supervisor. A file lock distinguishes the folder of a running supervisor from a stale one of a
killed supervisor. A supervisor that replaces one that was killed in flight takes over the stale folder, and with it the
processes that are still alive (adopted_process.py)."""

import fcntl
import os
import shutil
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from terrafix.core.clock import now_ns
from terrafix.runtime.progress_stamp import Progress

SHM = Path("/dev/shm")  # memory instead of disk, so that frames and progress stamps do not wait for storage
PREFIX = "terrafix-"
LOCK_ATTEMPTS, LOCK_PAUSE_S = 20, 0.005  # whoever only looks whether a lock is held holds it itself for microseconds
SAME_FLIGHT_NS = 60_000_000_000  # a killed run with progress within this time belongs to the flight in progress


@dataclass(frozen=True)
class RunDir:
    """Paths in the run folder ``path``."""

    path: Path

    def address(self, process: str) -> str:
        """Endpoint on which ``process`` publishes."""
        return f"ipc://{self.path / process}.ipc"

    def progress(self, process: str) -> Path:
        return self.path / f"{process}.progress"

    def user_error(self, process: str) -> Path:
        """Why ``process`` could not start, if it is a user error: one line."""
        return self.path / f"{process}.user_error"

    def gave_up(self, process: str) -> Path:
        """Exists when ``process`` will not be restarted."""
        return self.path / f"{process}.gave_up"

    def pid(self, process: str) -> Path:
        """Which process is running as ``process`` (adopted_process.py)."""
        return self.path / f"{process}.pid"

    @property
    def is_supervised(self) -> bool:
        """Whether its supervisor is running."""
        return _is_held(self.path / "lock")

    def checkpoint(self, process: str) -> Path:
        """State that ``process`` saves for its next instance (runtime/checkpoint.py)."""
        return self.path / f"{process}.checkpoint"

    def cache_dir(self, process: str) -> Path:
        """Folder for results that ``process`` could compute again, but only slowly."""
        return self.path / f"{process}.cache"

    @property
    def frames(self) -> Path:
        return self.path / "frames"

    @property
    def spec(self) -> Path:
        return self.path / "spec.json"

    @property
    def epoch_ns(self) -> int | None:
        """``t_ns`` of the first Origin of this run. A reopened source continues on the same time axis."""
        return int(self._epoch.read_text()) if self._epoch.exists() else None

    def set_epoch(self, t_ns: int) -> None:
        """Only the first call has an effect."""
        if not self._epoch.exists():
            write_atomic(self._epoch, str(t_ns).encode())

    @property
    def _epoch(self) -> Path:
        return self.path / "epoch_ns"

    def was_alive_recently(self) -> bool:
        """Whether its source was open and a process made progress within SAME_FLIGHT_NS."""
        return self._epoch.exists() and now_ns() - self._last_progress_ns() <= SAME_FLIGHT_NS

    def _last_progress_ns(self) -> int:
        """The newest progress stamp of its processes; 0: there is none."""
        newest_ns = 0
        for file in self.path.glob("*.progress"):
            progress = Progress(file)
            newest_ns = max(newest_ns, progress.stamp_ns)
            progress.close()
        return newest_ns


def write_atomic(file: Path, data: bytes) -> None:
    """Writes a temporary file and renames it: ``file`` is complete or unchanged, also if this process is killed."""
    temporary = file.with_suffix(".new")
    temporary.write_bytes(data)
    temporary.replace(file)


class OwnedRunDir:
    """The run folder of a supervisor, which creates, locks and removes it.

    ``keep_for_successor``: ``remove`` leaves the folder for a supervisor that resumes the run."""

    keep_for_successor = False

    def __init__(self, parent: Path | None = None, spec: bytes = b"", *, resume: bool = False) -> None:
        """``spec``: content of the spec file. ``resume``: takes over the folder of a killed run of the same flight."""
        parent = parent or _default_parent()
        killed = _take_over(parent, spec) if resume else None
        if killed is not None:
            self.run_dir, self._lock_fd = killed
            for file in (*self.run_dir.path.glob("*.gave_up"), *self.run_dir.path.glob("*.user_error")):
                file.unlink()  # with a new supervisor they are tried again
        else:
            self.run_dir = RunDir(Path(tempfile.mkdtemp(prefix=PREFIX, dir=parent)))
            # The kernel releases an exclusive lock when its holder ends, also if it is killed.
            self._lock_fd = os.open(self.run_dir.path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
            fcntl.flock(self._lock_fd, fcntl.LOCK_EX)
            self.run_dir.spec.write_bytes(spec)
        remove_stale_runs(parent)

    def remove(self) -> None:
        if not self.keep_for_successor:
            shutil.rmtree(self.run_dir.path, ignore_errors=True)
        os.close(self._lock_fd)


def _default_parent() -> Path:
    return SHM if os.access(SHM, os.W_OK) else Path(tempfile.gettempdir())


def live_runs(parent: Path | None = None) -> list[RunDir]:
    """The folders of running supervisors. A folder of another user cannot be read and counts as running."""
    folders = _folders(parent)
    return [RunDir(folder) for folder in folders if not os.access(folder, os.X_OK) or _is_held(folder / "lock")]


def recently_killed_runs(parent: Path | None = None) -> list[RunDir]:
    """The folders of this user whose supervisor was killed in the flight in progress."""
    readable = (folder for folder in _folders(parent) if os.access(folder, os.X_OK))
    killed = (RunDir(folder) for folder in readable if not _is_held(folder / "lock"))
    return [run for run in killed if run.was_alive_recently()]


def _folders(parent: Path | None) -> list[Path]:
    return sorted((parent or _default_parent()).glob(f"{PREFIX}*"))


def _is_held(lock: Path) -> bool:
    try:
        fd = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
    except OSError:
        return False  # removed meanwhile
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(fd)
    return False


def _take_over(parent: Path, spec: bytes) -> tuple[RunDir, int] | None:
    """The folder of a run with this spec that was killed in the flight in progress, and the descriptor of its lock,
    which this process then holds. None: there is none."""
    for folder in _folders(parent):
        killed = RunDir(folder)
        with suppress(OSError):  # of another user, or removed meanwhile
            if not killed.spec.is_file() or killed.spec.read_bytes() != spec or not killed.was_alive_recently():
                continue
            fd = os.open(folder / "lock", os.O_RDWR | os.O_CLOEXEC)
            if _lock(fd):
                return killed, fd
            os.close(fd)  # its supervisor is running
    return None


def _lock(fd: int) -> bool:
    """Takes the lock. False: another process keeps it."""
    for _ in range(LOCK_ATTEMPTS):
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            time.sleep(LOCK_PAUSE_S)
        else:
            return True
    return False


def remove_stale_runs(parent: Path) -> None:
    """Removes the folders of supervisors that no longer run. One of a run that was killed in flight recently is kept
    for its successor."""
    for lock in parent.glob(f"{PREFIX}*/lock"):
        try:
            fd = os.open(lock, os.O_RDWR | os.O_CLOEXEC)
        except OSError:
            continue  # of another user, or removed meanwhile
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            continue  # its supervisor is running
        else:
            if not RunDir(lock.parent).was_alive_recently():
                shutil.rmtree(lock.parent, ignore_errors=True)
        finally:
            os.close(fd)
