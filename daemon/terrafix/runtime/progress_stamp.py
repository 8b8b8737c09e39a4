"""Progress of a process in shared memory (heartbeat): written by its shell, read by the supervisor.

The stamp is written after finished work, so that the supervisor detects a process that is alive but stuck in a call."""

import mmap
from pathlib import Path

_SIZE = 4096
_STAMP, _WORKING, _QUEUED = 0, 1, 2  # words of 8 bytes; each is written by one store instruction, so atomically


class Progress:
    """The supervisor creates the file (``create``) before the first start; the process opens it (constructor)."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _SIZE)
        self._words = memoryview(self._memory).cast("Q")

    @classmethod
    def create(cls, path: Path) -> "Progress":
        path.write_bytes(bytes(_SIZE))
        return cls(path)

    def begin(self) -> None:
        """Work begins."""
        self._words[_WORKING] = 1

    def stamp(self, now_ns: int, queued: int = 0) -> None:
        """Work is finished at ``now_ns``, with ``queued`` messages in the queue."""
        self._words[_QUEUED] = queued
        self._words[_WORKING] = 0
        self._words[_STAMP] = now_ns

    def reset(self) -> None:
        """Back to "never stamped", before the process is started again."""
        self.stamp(0)

    @property
    def stamp_ns(self) -> int:
        """Time of the last stamp; 0: the process is not ready yet."""
        return self._words[_STAMP]

    @property
    def idle(self) -> bool:
        """No work in progress and no queued message."""
        return self._words[_WORKING] == 0 and self._words[_QUEUED] == 0

    def close(self) -> None:
        self._words.release()
        self._memory.close()
