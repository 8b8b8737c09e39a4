"""Frame stores: pixels by frame id, in one process (replay) or in shared memory (live).

The shared ring has one writer and any number of readers, and nobody waits. A file that is mapped by hand, not
multiprocessing.shared_memory: that one registers every reader with a resource tracker, which unlinks the memory
of the living when a reader dies (Python < 3.13). Who owns the folder removes the file (runtime/run_dir.py).

Slot = 64 bytes of header (generation, frame id + 1, height, width) and the pixels. The writer makes the generation
odd, writes, and makes it even again; a reader copies and takes the copy only if the generation was even and is
still the same (a sequence lock). So an overwritten or half-written frame is ``None``, never a torn image."""

import mmap
import os
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from terrafix.core.errors import OutputError
from terrafix.core.node import FrameStore, Image

MAGIC = 0x31465852_52455431  # layout version 1
BUDGET_BYTES = 192 * 2**20  # a tenth of the memory goal; 31 full-HD frames, 3 s at 10 Hz
MAX_SLOTS = 32  # nobody is later than this many frames and still useful
MIN_SLOTS = 4  # frames of 26 megapixels (78 MB each) exceed the budget, but come slowly
CHANNELS = 3  # BGR
_PAGE = 4096
_SLOT_HEADER_WORDS = 8
_MAGIC, _SLOTS, _SLOT_BYTES = range(3)  # words of the file header
_GENERATION, _FRAME, _HEIGHT, _WIDTH = range(4)  # words of a slot header


@runtime_checkable
class FrameWriter(FrameStore, Protocol):
    """The store as the one process has it that says Frame."""

    def put(self, frame_id: int, image: Image) -> None: ...


class MemoryFrameStore:
    """The newest frames of this process: ``capacity`` of them, fewer of large ones, as in the live ring. What it
    returns is read-only: all readers share it."""

    def __init__(self, capacity: int = MAX_SLOTS) -> None:
        self._capacity = capacity
        self._frames: OrderedDict[int, Image] = OrderedDict()

    def put(self, frame_id: int, image: Image) -> None:
        shared = image.view()
        shared.flags.writeable = False
        self._frames.pop(frame_id, None)
        self._frames[frame_id] = shared
        while len(self._frames) > min(self._capacity, _slots_for(image.nbytes)):
            self._frames.popitem(last=False)

    def get(self, frame_id: int) -> Image | None:
        return self._frames.get(frame_id)


class SharedFrameStore:
    """Ring of frames in the file ``path``. The file is made by the first ``put`` and sized by its image.

    A writer that starts again goes on in the same file, so its readers notice nothing. An image that is larger
    than the slots gets a new file in the same place; readers see that theirs is no longer the one there."""

    def __init__(self, path: Path, *, writer: bool = False, slots: int = 0, slot_bytes: int = 0) -> None:
        """``slots`` and ``slot_bytes``: at least so large, whatever the first image; 0: by the first image."""
        self._path = path
        self._writer = writer
        self._slots = slots
        self._slot_bytes = slot_bytes
        self._ring: _Ring | None = None

    def put(self, frame_id: int, image: Image) -> None:
        """``image``: (H, W, 3) uint8. Raises OutputError when shared memory has no room for the ring."""
        if not self._writer:
            raise ValueError("this store was opened for reading")
        if image.dtype != np.uint8 or image.ndim != CHANNELS or image.shape[2] != CHANNELS:
            raise ValueError(f"a frame is (H, W, 3) uint8, not {image.shape} {image.dtype}")
        self._writable(image.nbytes).put(frame_id, image)

    def get(self, frame_id: int) -> Image | None:
        """A copy that belongs to the caller, or None: never written, overwritten, or just being overwritten."""
        if self._ring is not None and self._ring.replaced(self._path):
            self.close()
        if self._ring is None:
            self._ring = _Ring.open(self._path)
        return self._ring.get(frame_id) if self._ring is not None else None

    def close(self) -> None:
        if self._ring is not None:
            self._ring.close()
            self._ring = None

    def _writable(self, nbytes: int) -> "_Ring":
        ring = self._ring or _Ring.open(self._path)
        if ring is None or ring.slot_bytes < nbytes:
            size = max(nbytes, self._slot_bytes)
            larger = _Ring.create(self._path, self._slots or _slots_for(size), size)
            if ring is not None:
                ring.close()
            ring = larger
        self._ring = ring
        return ring


def _slots_for(slot_bytes: int) -> int:
    return max(MIN_SLOTS, min(MAX_SLOTS, BUDGET_BYTES // slot_bytes))


class _Ring:
    """One mapped file."""

    def __init__(self, fd: int) -> None:
        status = os.fstat(fd)
        self._inode = status.st_ino
        self._memory = mmap.mmap(fd, status.st_size)
        self._head = np.frombuffer(self._memory, np.uint64, _PAGE // 8)
        slots, self.slot_bytes = int(self._head[_SLOTS]), int(self._head[_SLOT_BYTES])
        words = slots * _SLOT_HEADER_WORDS
        self._headers = np.frombuffer(self._memory, np.uint64, words, _PAGE).reshape(slots, _SLOT_HEADER_WORDS)
        offset = _data_offset(slots)
        pixels = np.frombuffer(self._memory, np.uint8, slots * self.slot_bytes, offset)
        self._pixels = pixels.reshape(slots, self.slot_bytes)
        self._fence_lock = threading.Lock()

    @classmethod
    def open(cls, path: Path) -> "_Ring | None":
        """None: there is no ring yet."""
        try:
            fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError:
            return None
        try:
            ring = cls(fd)
        finally:
            os.close(fd)
        if int(ring._head[_MAGIC]) != MAGIC:
            raise ValueError(f"{path} is not a frame ring of this version")
        return ring

    @classmethod
    def create(cls, path: Path, slots: int, slot_bytes: int) -> "_Ring":
        slot_bytes = -(-slot_bytes // _PAGE) * _PAGE
        fresh = path.with_name(path.name + ".new")
        fd = os.open(fresh, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            _allocate(fd, path, _data_offset(slots) + slots * slot_bytes)
            header = np.array([MAGIC, slots, slot_bytes], np.uint64)
            os.pwrite(fd, header.tobytes(), 0)
            os.replace(fresh, path)  # readers see the old ring or the whole new one
            return cls(fd)
        finally:
            os.close(fd)

    def replaced(self, path: Path) -> bool:
        """Another file lies at ``path`` now. (The number of a file that is still mapped is not given out again.)"""
        return os.stat(path).st_ino != self._inode

    def put(self, frame_id: int, image: Image) -> None:
        slot = frame_id % len(self._headers)
        header = self._headers[slot]
        # Odd, and never what it was: also when the last writer died in the middle and left it odd.
        generation = (int(header[_GENERATION]) + 1) | 1
        header[_GENERATION] = generation
        self._fence()
        header[_FRAME] = frame_id + 1
        header[_HEIGHT], header[_WIDTH] = image.shape[:2]
        target = self._pixels[slot, : image.nbytes].reshape(image.shape)
        np.copyto(target, image)
        self._fence()
        header[_GENERATION] = generation + 1

    def get(self, frame_id: int) -> Image | None:
        slot = frame_id % len(self._headers)
        header = self._headers[slot]
        generation = int(header[_GENERATION])
        self._fence()
        if generation % 2 or int(header[_FRAME]) != frame_id + 1:
            return None
        shape = (int(header[_HEIGHT]), int(header[_WIDTH]), CHANNELS)
        size = shape[0] * shape[1] * CHANNELS
        if size > self.slot_bytes:
            return None  # header of another generation, caught in the middle
        image = self._pixels[slot, :size].reshape(shape).copy()
        self._fence()
        return image if int(header[_GENERATION]) == generation else None

    def close(self) -> None:
        del self._head, self._headers, self._pixels
        self._memory.close()

    def _fence(self) -> None:
        """A full memory barrier. x86 needs none here, ARM does: memory accesses may otherwise pass each other.

        Acquire and release each stop one direction; a release followed by an acquire lets nothing through
        (ARM Architecture Reference Manual, B2.3: RCsc), which two pairs in a row guarantee. 0.3 microseconds."""
        for _ in range(2):
            self._fence_lock.acquire()
            self._fence_lock.release()


def _data_offset(slots: int) -> int:
    return _PAGE + -(-slots * _SLOT_HEADER_WORDS * 8 // _PAGE) * _PAGE


def _allocate(fd: int, path: Path, size: int) -> None:
    """Memory is taken now: a write beyond what a small /dev/shm has would kill the process with SIGBUS later."""
    try:
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        os.ftruncate(fd, 0)
        raise OutputError(
            f"{path}: no room for the frames ({size / 2**20:.0f} MiB: {error.strerror}); enlarge {path.parent.parent}"
            " (docker: --shm-size) or use smaller frames"
        ) from None
