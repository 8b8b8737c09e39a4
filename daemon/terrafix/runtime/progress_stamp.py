"""Progress of a process in a few bytes of shared memory: written by its shell, read by the supervisor.

A stamp follows finished work, so that a process that is alive but stuck in one call is seen."""

import mmap
from pathlib import Path

_SIZE = 4096
_STAMP, _WORKING, _QUEUED = 0, 1, 2  # words of 8 bytes; each is written in one store


class Progress:
    """``create`` by the supervisor before a start, ``open`` by the process itself."""

    def __init__(self, path: Path) -> None:
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _SIZE)
        self._words = memoryview(self._memory).cast("Q")

    @classmethod
    def create(cls, path: Path) -> "Progress":
        path.write_bytes(bytes(_SIZE))
        return cls(path)

    def begin(self) -> None:
        self._words[_WORKING] = 1

    def stamp(self, now_ns: int, queued: int = 0) -> None:
        """Work is done at ``now_ns`` and ``queued`` messages wait."""
        self._words[_QUEUED] = queued
        self._words[_WORKING] = 0
        self._words[_STAMP] = now_ns

    def reset(self) -> None:
        """Back to "never stamped", for the next life of the process."""
        self.stamp(0)

    @property
    def stamp_ns(self) -> int:
        """Time of the last stamp; 0: not ready yet."""
        return self._words[_STAMP]

    @property
    def idle(self) -> bool:
        return self._words[_WORKING] == 0 and self._words[_QUEUED] == 0

    def close(self) -> None:
        self._words.release()
        self._memory.close()
