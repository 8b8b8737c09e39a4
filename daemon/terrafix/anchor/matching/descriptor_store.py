"""Descriptors of the map that outlive the process that computed them.

Half of the first look of a new process is computing what the one before it had already; and after a restart in flight
that look is what the autopilot waits for. So what was computed lies in the folder of the run, too, which is memory."""

import hashlib
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from terrafix.runtime.run_dir import load, save

MOST = 96  # of all layers, of 1 MB each: what a flight in sight of one place uses is some 20


class _Written(msgspec.Struct, frozen=True):
    shape: tuple[int, int, int]
    descriptors: bytes  # float16
    valid: bytes  # bool


class DescriptorStore:
    """``of``: all that the descriptors follow from, but for who describes and which tile it is. At ``most`` so many."""

    def __init__(self, folder: Path, of: str, most: int = MOST) -> None:
        self._folder = folder
        self._most = most
        self._prefix = hashlib.sha256(of.encode()).hexdigest()[:16]
        with suppress(OSError):  # no room: nothing is kept
            folder.mkdir(exist_ok=True)
        found = folder.glob(f"{self._prefix} *.tile")
        self._files = OrderedDict.fromkeys(sorted(found, key=lambda file: file.stat().st_mtime_ns))

    def take(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """-> descriptors (C, n, n) float16, valid (n, n) bool; None: not here, or not whole."""
        self.used(name)
        written = load(self._file(name), msgspec.msgpack.Decoder(_Written).decode)
        if written is None:
            return None
        try:
            descriptors = np.frombuffer(written.descriptors, np.float16).reshape(written.shape)
            return descriptors, np.frombuffer(written.valid, bool).reshape(written.shape[1:])
        except ValueError:
            return None

    def used(self, name: str) -> None:
        """It gives way after all that were not."""
        file = self._file(name)
        if file in self._files:
            self._files.move_to_end(file)

    def put(self, name: str, descriptors: np.ndarray, valid: np.ndarray) -> None:
        """Those that were not used for longest give way."""
        c, h, w = descriptors.shape
        file = self._file(name)
        save(file, msgspec.msgpack.encode(_Written((c, h, w), descriptors.tobytes(), valid.tobytes())))
        self._files[file] = None
        self._files.move_to_end(file)
        while len(self._files) > self._most:
            oldest, _ = self._files.popitem(last=False)
            with suppress(OSError):
                oldest.unlink()

    def _file(self, name: str) -> Path:
        return self._folder / f"{self._prefix} {name}.tile"
