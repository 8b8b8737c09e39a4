"""Map descriptors as files in the run directory (memory), so that a restarted process does not compute them again.

Half of the time of a new process's first correlation is computing these descriptors, and after a restart in flight the
autopilot waits for that correlation.
"""

import hashlib
from collections import OrderedDict
from contextlib import suppress
from pathlib import Path

import msgspec
import numpy as np

from terrafix.runtime.checkpoint import CheckpointFile

# Tiles of all layers together, 1.1 MB each: more than the matcher keeps (DESCRIPTOR_CACHE_BYTES), those which a
# process started in its place needs. A flight around one place uses about 20. [tuned]
MAX_TILES = 48


class _StoredTile(msgspec.Struct, frozen=True):
    shape: tuple[int, int, int]
    descriptors: bytes  # float16
    valid: bytes  # bool


class DescriptorStore:
    """``identity``: text on which the descriptors depend, apart from describer and tile name; it is hashed into the
    file names. ``max_tiles``: limit above which the least recently used file is deleted."""

    def __init__(self, folder: Path, identity: str, max_tiles: int = MAX_TILES) -> None:
        self._folder = folder
        self._max_tiles = max_tiles
        self._prefix = hashlib.sha256(identity.encode()).hexdigest()[:16]
        with suppress(OSError):  # no space left: nothing is stored
            folder.mkdir(exist_ok=True)
        found = folder.glob(f"{self._prefix} *.tile")
        self._files = OrderedDict.fromkeys(sorted(found, key=lambda file: file.stat().st_mtime_ns))

    def read(self, name: str) -> tuple[np.ndarray, np.ndarray] | None:
        """-> descriptors (C, n, n) float16, valid (n, n) bool; None: not stored, or the file is incomplete."""
        self.touch(name)
        tile = CheckpointFile(self._file(name), _StoredTile).load()
        if tile is None:
            return None
        try:
            descriptors = np.frombuffer(tile.descriptors, np.float16).reshape(tile.shape)
            return descriptors, np.frombuffer(tile.valid, bool).reshape(tile.shape[1:])
        except ValueError:
            return None

    def touch(self, name: str) -> None:
        """Marks a tile as most recently used."""
        file = self._file(name)
        if file in self._files:
            self._files.move_to_end(file)

    def write(self, name: str, descriptors: np.ndarray, valid: np.ndarray) -> None:
        """Writes a tile and deletes the least recently used ones above the limit."""
        c, h, w = descriptors.shape
        file = self._file(name)
        CheckpointFile(file, _StoredTile).save(_StoredTile((c, h, w), descriptors.tobytes(), valid.tobytes()))
        self._files[file] = None
        self._files.move_to_end(file)
        while len(self._files) > self._max_tiles:
            oldest, _ = self._files.popitem(last=False)
            with suppress(OSError):
                oldest.unlink()

    def _file(self, name: str) -> Path:
        return self._folder / f"{self._prefix} {name}.tile"
