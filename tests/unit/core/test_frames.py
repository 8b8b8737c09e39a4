"""Frame stores: overwritten frames read as None, and no image is torn."""

import multiprocessing
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

from terrafix.core import frames as frames_module
from terrafix.core.errors import OutputError
from terrafix.core.frames import FrameWriter, MemoryFrameStore, SharedFrameStore


def image(value: int, height: int = 20, width: int = 30) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def test_the_memory_store_keeps_the_newest_frames_read_only() -> None:
    store = MemoryFrameStore(2)
    for i in range(3):
        store.put(i, image(i))
    assert store.get(0) is None
    kept = store.get(2)
    assert kept is not None and kept[0, 0, 0] == 2
    with pytest.raises(ValueError, match="read-only"):
        kept[0, 0, 0] = 9
    assert isinstance(store, FrameWriter)


def test_the_shared_store_returns_copies_and_none_for_missing_frames(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    reader = SharedFrameStore(path)
    assert reader.get(0) is None, "no writer yet"
    writer = SharedFrameStore(path, writer=True, slots=4)
    for i in range(6):
        writer.put(i, image(i))
    assert [reader.get(i) is None for i in range(7)] == [True, True, False, False, False, False, True]
    copy = reader.get(5)
    assert copy is not None
    copy[:] = 99
    again = reader.get(5)
    assert again is not None and np.array_equal(again, image(5))
    with pytest.raises(ValueError, match="opened for reading"):
        reader.put(1, image(1))
    with pytest.raises(ValueError, match=r"\(H, W, 3\) uint8"):
        writer.put(1, image(1).astype(np.float32))


def test_a_larger_image_replaces_the_ring_and_readers_reopen_it(tmp_path: Path) -> None:
    writer = SharedFrameStore(tmp_path / "frames", writer=True, slots=4)
    reader = SharedFrameStore(tmp_path / "frames")
    writer.put(0, image(1))
    assert reader.get(0) is not None
    writer.put(1, image(2, 400, 300))
    large = reader.get(1)
    assert large is not None and np.array_equal(large, image(2, 400, 300))
    assert reader.get(0) is None
    writer.put(2, image(3))  # a smaller image uses the same ring
    assert reader.get(1) is not None
    small = reader.get(2)
    assert small is not None and small.shape == (20, 30, 3)


def test_reader_and_writer_of_the_frame_ring_may_restart(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    first = SharedFrameStore(path, writer=True, slots=4)
    first.put(0, image(1))
    reader = SharedFrameStore(path)
    assert reader.get(0) is not None
    second = SharedFrameStore(path, writer=True, slots=4)
    second.put(1, image(2))
    assert reader.get(0) is not None, "the new writer continues in the same ring"
    assert reader.get(1) is not None
    assert SharedFrameStore(path).get(1) is not None


def test_a_partially_written_frame_reads_as_none_and_the_next_writer_overwrites_it(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    code = f"""
import os
from pathlib import Path
import numpy as np
from terrafix.core.frames import SharedFrameStore
store = SharedFrameStore(Path({str(path)!r}), writer=True, slots=2)
store.put(0, np.zeros((20, 30, 3), np.uint8))
np.copyto = lambda *_: os._exit(9)  # dies between the two generations
store.put(2, np.zeros((20, 30, 3), np.uint8))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 9
    reader = SharedFrameStore(path)
    assert reader.get(0) is None and reader.get(2) is None
    SharedFrameStore(path, writer=True, slots=2).put(4, image(4))
    repaired = reader.get(4)
    assert repaired is not None and np.array_equal(repaired, image(4))


def write_continuously(path: str, ready: "multiprocessing.synchronize.Event") -> None:
    store = SharedFrameStore(Path(path), writer=True, slots=2)
    frame_id = 0
    while True:
        store.put(frame_id, image(frame_id % 251, 480, 640))
        ready.set()
        frame_id += 1


@pytest.mark.slow
def test_no_image_is_torn_while_another_process_writes_continuously(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    ready = spawn.Event()
    writer = spawn.Process(target=write_continuously, args=(str(tmp_path / "frames"), ready), daemon=True)
    writer.start()
    try:
        assert ready.wait(20)
        reader = SharedFrameStore(tmp_path / "frames")
        whole, overwritten, newest = 0, 0, 0
        stop = threading.Timer(1.5, lambda: None)
        stop.start()
        while stop.is_alive():
            while reader.get(newest) is None and stop.is_alive():
                newest += 1  # the writer is ahead: catch up
            for frame_id in (newest, newest + 1):
                seen = reader.get(frame_id)
                if seen is None:
                    overwritten += 1
                else:
                    whole += 1
                    assert seen.min() == seen.max() == frame_id % 251, "torn"
    finally:
        writer.kill()
        writer.join()
    assert whole > 10, (whole, overwritten)


def test_large_photos_get_few_slots_and_full_memory_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert frames_module._slots_for(6252 * 4168 * 3) == frames_module.MIN_SLOTS
    assert frames_module._slots_for(1280 * 720 * 3) == frames_module.MAX_SLOTS
    store = SharedFrameStore(tmp_path / "frames", writer=True, slots=4, slot_bytes=2**50)
    with pytest.raises(OutputError, match=r"no room for the frames \(4294967296 MiB: .*\); enlarge"):
        store.put(0, image(0))


def test_a_photo_of_26_megapixels_passes_through_shared_memory(tmp_path: Path) -> None:
    store = SharedFrameStore(Path("/dev/shm") / f"terrafix-test-{tmp_path.name}", writer=True, slots=2)
    try:
        photo = np.zeros((4168, 6252, 3), np.uint8)
        photo[-1, -1] = (1, 2, 3)
        store.put(3, photo)
        seen = store.get(3)
        assert seen is not None and tuple(seen[-1, -1]) == (1, 2, 3)
    finally:
        store.close()
        Path("/dev/shm", f"terrafix-test-{tmp_path.name}").unlink()


def test_the_frame_ring_survives_its_readers_without_resource_tracker_warnings(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
import numpy as np
from terrafix.core.frames import SharedFrameStore
SharedFrameStore(Path({str(tmp_path / "frames")!r}), writer=True).put(0, np.zeros((9, 9, 3), np.uint8))
SharedFrameStore(Path({str(tmp_path / "frames")!r})).get(0)
"""
    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr == "" and (tmp_path / "frames").exists()
