"""Frame stores: pixels by frame id, in one process (replay) or in shared memory (live).

The shared ring buffer has one writer and any number of readers and is wait-free. It is a memory-mapped file instead of
multiprocessing.shared_memory, because the latter registers every reader with a resource tracker that unlinks the
memory for all processes when one reader dies (Python < 3.13). The owner of the run folder removes the file
(runtime/run_dir.py).

A slot is a header of 64 bytes (generation, frame id + 1, height, width) followed by the pixels. Access is by sequence
lock: the writer makes the generation odd, writes, and makes it even again; a reader copies the slot and accepts the
copy if the generation was even before and is unchanged after. An overwritten or partially written frame therefore
reads as ``None``."""

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
BUDGET_BYTES = 192 * 2**20  # a tenth of the memory of a computer with 2 GB; 20 full-HD frames are 118 MiB
MAX_SLOTS = 20  # a consumer that lags by more frames than this gives no useful result: 2 s at 10 Hz
MIN_SLOTS = 4  # frames of 26 megapixels (78 MB each) exceed the budget, but arrive at a low rate
IMAGE_CHANNELS = 3  # BGR
_PAGE = 4096
_SLOT_HEADER_WORDS = 8
_MAGIC, _SLOTS, _SLOT_BYTES = range(3)  # words of the file header
_GENERATION, _FRAME, _HEIGHT, _WIDTH = range(4)  # words of a slot header


@runtime_checkable
class FrameWriter(FrameStore, Protocol):
    """Frame store of the one process that publishes Frame."""

    def put(self, frame_id: int, image: Image) -> None: ...


class MemoryFrameStore:
    """The newest frames in the memory of this process: at most ``capacity``, fewer if they are large, as in the shared
    ring. ``get`` returns a read-only array that all readers share."""

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
    """Ring buffer of frames in the file ``path``. The first ``put`` creates the file and sizes it by its image.

    A restarted writer continues in the same file, which is transparent to readers. An image larger than the slots
    replaces the file; readers detect the replacement and reopen it."""

    def __init__(self, path: Path, *, writer: bool = False, slots: int = 0, slot_bytes: int = 0) -> None:
        """``slots`` and ``slot_bytes``: number of slots and least size of a slot; 0: derived from the first image."""
        self._path = path
        self._writer = writer
        self._slots = slots
        self._slot_bytes = slot_bytes
        self._ring: _Ring | None = None

    def put(self, frame_id: int, image: Image) -> None:
        """``image``: (H, W, 3) uint8 BGR. Raises OutputError when shared memory is too small for the ring."""
        if not self._writer:
            raise ValueError("this store was opened for reading")
        if image.dtype != np.uint8 or image.ndim != IMAGE_CHANNELS or image.shape[2] != IMAGE_CHANNELS:
            raise ValueError(f"a frame is (H, W, 3) uint8, not {image.shape} {image.dtype}")
        self._writable(image.nbytes).put(frame_id, image)

    def get(self, frame_id: int) -> Image | None:
        """A copy (H, W, 3) owned by the caller. None: the frame was never written, or is or was overwritten."""
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
    """One memory-mapped ring file."""

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
        """None: the file does not exist yet. Raises ValueError when it has another layout version."""
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
        temporary = path.with_name(path.name + ".new")
        fd = os.open(temporary, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        try:
            _allocate(fd, path, _data_offset(slots) + slots * slot_bytes)
            header = np.array([MAGIC, slots, slot_bytes], np.uint64)
            os.pwrite(fd, header.tobytes(), 0)
            os.replace(temporary, path)  # atomic: readers see the old ring or the complete new one
            return cls(fd)
        finally:
            os.close(fd)

    def replaced(self, path: Path) -> bool:
        """Whether ``path`` is now another file. The inode number of a file that is still mapped is not reused."""
        return os.stat(path).st_ino != self._inode

    def put(self, frame_id: int, image: Image) -> None:
        slot = frame_id % len(self._headers)
        header = self._headers[slot]
        # Odd and different from before, also when the previous writer died during a write and left it odd.
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
        shape = (int(header[_HEIGHT]), int(header[_WIDTH]), IMAGE_CHANNELS)
        size = shape[0] * shape[1] * IMAGE_CHANNELS
        if size > self.slot_bytes:
            return None  # the header is being overwritten
        image = self._pixels[slot, :size].reshape(shape).copy()
        self._fence()
        return image if int(header[_GENERATION]) == generation else None

    def close(self) -> None:
        del self._head, self._headers, self._pixels
        self._memory.close()

    def _fence(self) -> None:
        """Full memory barrier. Not needed on x86; on ARM memory accesses may otherwise be reordered.

        Acquire and release are one-way barriers; a release followed by an acquire is a full barrier (ARM Architecture
        Reference Manual, B2.3: RCsc), which two lock and unlock pairs in a row guarantee. Takes 0.3 microseconds."""
        for _ in range(2):
            self._fence_lock.acquire()
            self._fence_lock.release()


def _data_offset(slots: int) -> int:
    return _PAGE + -(-slots * _SLOT_HEADER_WORDS * 8 // _PAGE) * _PAGE


def _allocate(fd: int, path: Path, size: int) -> None:
    """Reserves the memory now, because a later write beyond the capacity of /dev/shm would raise SIGBUS.

    Raises OutputError when ``size`` bytes are not available."""
    try:
        os.posix_fallocate(fd, 0, size)
    except OSError as error:
        os.ftruncate(fd, 0)
        raise OutputError(
            f"{path}: no room for the frames ({size / 2**20:.0f} MiB: {error.strerror}); enlarge {path.parent.parent}"
            " (docker: --shm-size) or use smaller frames"
        ) from None
