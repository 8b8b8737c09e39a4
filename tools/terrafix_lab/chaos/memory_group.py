"""A control group of memory: the kernel kills a process in it that takes more than its limit (OOM killer)."""

import os
from contextlib import suppress
from pathlib import Path

from terrafix.core.errors import OutputError

V1 = Path("/sys/fs/cgroup/memory")  # its own hierarchy; without it, /sys/fs/cgroup is that of version 2
V2 = Path("/sys/fs/cgroup")


class MemoryGroup:
    """Needs root. Memory that a process took before it came into the group does not count."""

    def __init__(self, root: Path | None = None) -> None:
        """``root``: the hierarchy; None: that of this computer."""
        self._root = root or (V1 if V1.is_dir() else V2)
        self._folder = self._root / f"terrafix-chaos-{os.getpid()}"

    def limit(self, pid: int, limit_bytes: int) -> None:
        """From now on the process may take this much more. Raises OutputError."""
        name = "memory.limit_in_bytes" if self._root.name == "memory" else "memory.max"
        try:
            self._folder.mkdir(exist_ok=True)
            (self._folder / name).write_text(str(limit_bytes))
            (self._folder / "cgroup.procs").write_text(str(pid))
        except OSError as error:
            raise OutputError(f"{self._folder}: no control group of memory ({error.strerror}); run as root") from None

    def lift(self) -> None:
        """Takes the processes that live out of the group and removes it."""
        with suppress(OSError):
            for pid in (self._folder / "cgroup.procs").read_text().split():
                (self._root / "cgroup.procs").write_text(pid)
        with suppress(OSError):
            self._folder.rmdir()
