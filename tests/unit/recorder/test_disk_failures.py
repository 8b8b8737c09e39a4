"""The recorder on disks that are small, full, read-only or gone, and the budget of several run folders."""

import errno
import hashlib
import io
import json
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from mcap.opcode import Opcode

from flight_records import estimate, frame, origin
from small_disk import small_disk
from terrafix import messages as m
from terrafix.core import logs
from terrafix.core.config import Config, RecorderSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.recorder import segments
from terrafix.recorder.images import ImagePolicy
from terrafix.recorder.node import RecorderEdge
from terrafix.recorder.provenance import header
from terrafix.recorder.reader import ReadResult, read_flight
from terrafix.recorder.segments import FSYNC_S, MEGABYTE, PROTECTED, RETRY_S, SEGMENT_NS, SegmentRing
from terrafix.recorder.writer import FlightWriter
from terrafix.runtime.supervisor import _writable

BOOTS = ["a" * 32, "b" * 32, "c" * 32]


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


class Usage(NamedTuple):
    total: int
    used: int
    free: int


Disk = Callable[[int, int], None]


def failing(error: int, wait: Callable[[], object] = lambda: None) -> Callable[..., Any]:
    """-> a function that waits and then fails with this errno, whatever its arguments are."""

    def fail(*_: object, **__: object) -> None:
        wait()
        raise OSError(error, os.strerror(error))

    return fail


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    """Sets total and free space of the disk, in megabytes."""

    def of(total_mb: int, free_mb: int) -> None:
        total, free = total_mb * MEGABYTE, free_mb * MEGABYTE
        monkeypatch.setattr(segments.shutil, "disk_usage", lambda _: Usage(total, total - free, free))

    return of


def ring_in(folder: Path, clock: Clock, budget_mb: int = 64) -> SegmentRing:
    return SegmentRing(folder, header(Config()), budget_mb, clock)


def frames_of(folder: Path, result: ReadResult | None = None) -> list[int]:
    return [message.frame_id for _, _, message in read_flight(folder, result) if isinstance(message, m.Frame)]


def old_segment(folder: Path, number: int, size: int, modified_s: float) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / f"flight-{number:03d}.mcap"
    path.write_bytes(bytes(size))
    os.utime(path, (modified_s, modified_s))
    return path


def test_free_space_alone_never_costs_the_record_of_this_flight(tmp_path: Path, clock: Clock, disk: Disk) -> None:
    disk(24, 20)
    ring = ring_in(tmp_path, clock)
    ring.write(frame(0), 0)
    disk(24, 1)
    ring.flush()
    assert ring.blocked == "the free space of the disk is at its floor"
    ring.write(frame(1), 1)
    clock.now_s += RETRY_S
    ring.write(frame(2), 2)
    assert frames_of(tmp_path) == [0], "nothing more is written, and nothing is deleted"
    disk(24, 20)
    clock.now_s += RETRY_S
    ring.write(frame(3), 3)
    assert not ring.blocked and ring.take_lost() == {"Frame": 2}
    ring.close()
    assert frames_of(tmp_path) == [0, 3]


def test_the_floor_is_256_mb_or_a_tenth_of_a_small_disk(tmp_path: Path, clock: Clock, disk: Disk) -> None:
    for total_mb, free_mb, blocked in [(24, 3, False), (24, 2, True), (100_000, 300, False), (100_000, 200, True)]:
        disk(total_mb, free_mb)
        ring = ring_in(tmp_path, clock)
        assert bool(ring.blocked) == blocked, (total_mb, free_mb)
        ring.close()


def test_a_flight_starts_on_a_disk_that_takes_no_file_and_is_recorded_when_it_does(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(path: Path, _: dict[str, str]) -> None:
        path.touch()
        failing(errno.ENOSPC)()

    stream = io.StringIO()
    writer = logs.configure("INFO", "recorder", stream)
    with monkeypatch.context() as broken:
        broken.setattr(segments, "FlightWriter", full)
        ring = ring_in(tmp_path, clock)
        ring.write(origin(), 0)
        ring.write_thumbnail(0, 0, b"")
        clock.now_s += RETRY_S
        ring.write(frame(0), 1)
        ring.flush()
        assert "No space left" in ring.blocked and ring.take_lost() == {}, "kept until they can be recorded"
    assert list(tmp_path.iterdir()) == [], "no empty file is left by each attempt"
    ring.write(frame(1), 2)
    assert ring.blocked, "before the next attempt"
    clock.now_s += RETRY_S
    ring.write(frame(2), 3)
    ring.close()
    writer.close()
    assert frames_of(tmp_path) == [2]
    assert any(isinstance(message, m.Origin) for _, _, message in read_flight(tmp_path)), "of the time before"
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [(line["event"], line["level"]) for line in lines] == [
        ("recording stopped", "error"),
        ("recording continues", "warning"),
    ], "said once, not at every attempt"


@pytest.mark.parametrize("method", ["write", "flush", "sync", "write_thumbnail", "write_frame_image"])
def test_a_disk_that_fails_in_flight_ends_the_segment_and_raises_nothing(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    ring = ring_in(tmp_path, clock)
    ring.write(frame(0), 0)
    ring.flush()
    with monkeypatch.context() as broken:
        broken.setattr(FlightWriter, method, failing(errno.EIO))
        ring.write(frame(1), 1)
        ring.write_thumbnail(1, 1, b"x")
        ring.write_frame_image(1, 1, b"x", "png")
        clock.now_s += FSYNC_S
        for _ in range(2):  # an error of the synchronisation is known at the next flush
            ring.flush()
            end_of_sync(ring)
        assert ring.blocked == os.strerror(errno.EIO)
    clock.now_s += RETRY_S
    ring.write(frame(2), 2)
    assert not ring.blocked
    ring.close()
    kept = frames_of(tmp_path)
    assert kept[0] == 0 and kept[-1] == 2
    assert len(list(tmp_path.glob("*.mcap"))) == 2


def end_of_sync(ring: SegmentRing) -> None:
    if ring._sync is not None:
        ring._sync.join(5.0)


class _Room:
    """Bytes that files on a disk still take."""

    def __init__(self) -> None:
        self.bytes = 1 << 40


class _FileOnFullDisk(io.FileIO):
    """Takes the part of a write for which there is room, and then no more, as a file of a full disk does."""

    def __init__(self, path: Path, room: _Room) -> None:
        super().__init__(path, "w")
        self._room = room

    def write(self, data: Any) -> int:
        if self._room.bytes <= 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        part = bytes(data)[: self._room.bytes]
        self._room.bytes -= len(part)
        return super().write(part)


def numbered(i: int) -> m.Frame:
    """A frame with a name that hardly compresses, so that chunks have kilobytes."""
    return m.Frame(t_ns=i, frame_id=i, file=hashlib.sha512(bytes([i % 256])).hexdigest(), width=1, height=1)


@pytest.mark.parametrize("room_bytes", [0, 1, 8, 9, 40, 300, 700, 1500, 2500, 4000])
def test_a_disk_that_fills_amid_a_write_costs_what_it_does_not_take_and_no_more(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, room_bytes: int
) -> None:
    room, path_open = _Room(), Path.open

    def opened(path: Path, mode: str = "r", *rest: Any, **more: Any) -> Any:
        if mode == "wb":
            return io.BufferedWriter(_FileOnFullDisk(path, room))
        return path_open(path, mode, *rest, **more)

    monkeypatch.setattr(Path, "open", opened)
    ring, sent, lost = ring_in(tmp_path, clock), [numbered(i) for i in range(120)], Counter[str]()
    for i, message in enumerate(sent):
        if i == 40:
            room.bytes = room_bytes
        if i == 80:
            assert ring.blocked == os.strerror(errno.ENOSPC)
            room.bytes = 1 << 40
            clock.now_s += RETRY_S
        ring.write(message, message.t_ns)
        if i % 10 == 9:
            ring.flush()
        lost += ring.take_lost()
    ring.close()
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["flight-000.mcap", "flight-001.mcap"]
    found = [message for _, _, message in read_flight(tmp_path) if isinstance(message, m.Frame)]
    kept = {message.frame_id for message in found}
    assert found == [message for message in sent if message.frame_id in kept], "in order, and none altered"
    assert {*range(40), *range(80, 120)} <= kept
    whole_chunks = len(kept) - 80
    assert lost == {"Frame": 40 - whole_chunks}, "all that is missing is counted, what was flushed is not"


def test_a_record_goes_on_in_a_new_file_when_a_real_disk_was_full_for_a_time(tmp_path: Path, clock: Clock) -> None:
    with small_disk(tmp_path / "disk", 4) as disk:
        folder = disk.folder / "run"
        ring = ring_in(folder, clock)
        for i in range(120):
            if i == 40:
                ring.flush()
                disk.fill(free_bytes=4096)
            if i == 80:
                assert ring.blocked == os.strerror(errno.ENOSPC)
                disk.free()
                clock.now_s += RETRY_S
            ring.write_frame_image(i, i, os.urandom(3000), "png")
            ring.write(numbered(i), i)
            if i % 10 == 9:
                ring.flush()
        assert not ring.blocked
        ring.close()
        kept = frames_of(folder)
        assert {*range(40), *range(80, 120)} <= set(kept) and len(kept) < 90


def test_a_folder_that_vanished_is_made_again(tmp_path: Path, clock: Clock) -> None:
    folder = tmp_path / "run"
    ring = ring_in(folder, clock)
    ring.write(frame(0), 0)
    shutil.rmtree(folder)
    ring.flush()
    assert ring.blocked
    clock.now_s += RETRY_S
    ring.write(frame(1), 1)
    ring.close()
    assert frames_of(folder) == [1]


def test_what_is_flushed_reaches_the_disk_once_a_second(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[float] = []
    monkeypatch.setattr(FlightWriter, "sync", lambda _: synced.append(clock.now_s))
    ring = ring_in(tmp_path, clock)
    for _ in range(12):
        clock.now_s += 0.25
        ring.flush()
        end_of_sync(ring)
    ring.close()
    assert synced == [101.0, 102.0, 103.0]


def test_messages_reach_the_operating_system_while_the_disk_stalls(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on, begun = threading.Event(), []

    def stall(_: FlightWriter) -> None:
        begun.append(clock.now_s)
        goes_on.wait(5.0)

    monkeypatch.setattr(FlightWriter, "sync", stall)
    ring = ring_in(tmp_path, clock)
    for number in range(4):
        clock.now_s += FSYNC_S
        ring.write(frame(number), number)
        ring.flush()
    assert frames_of(tmp_path) == [0, 1, 2, 3], "as after a kill at this time"
    assert len(begun) == 1, "one at a time"
    goes_on.set()
    end_of_sync(ring)
    ring.close()


def test_a_late_error_of_the_synchronisation_of_an_ended_file_does_not_end_the_next_one(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    goes_on = threading.Event()
    ring = ring_in(tmp_path, clock)
    with monkeypatch.context() as broken:
        broken.setattr(FlightWriter, "sync", failing(errno.EIO, lambda: goes_on.wait(5.0)))
        clock.now_s += FSYNC_S
        ring.flush()
        ring.write(frame(0), SEGMENT_NS + 1)
        ring.write(frame(1), 2 * SEGMENT_NS + 2)  # after it the next file begins
        goes_on.set()
        end_of_sync(ring)
    ring.flush()
    assert not ring.blocked
    ring.close()


def test_sync_is_an_fsync_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    descriptors: list[int] = []
    monkeypatch.setattr(os, "fsync", descriptors.append)
    writer = FlightWriter(tmp_path / "flight.mcap", header(Config()))
    writer.sync()
    assert len(descriptors) == 1
    writer.close()


def test_run_folders_of_the_unit_share_the_budget_and_the_oldest_flight_goes_first(
    tmp_path: Path, clock: Clock
) -> None:
    oldest = [old_segment(tmp_path / BOOTS[0], n, 20 * MEGABYTE, 1000.0 + n) for n in (0, 1)]
    newer = old_segment(tmp_path / BOOTS[1], 0, 20 * MEGABYTE, 2000.0)
    ring_in(tmp_path / BOOTS[2], clock).close()
    assert [path.exists() for path in (*oldest, newer)] == [False, True, True], "60 MB and a segment of 8 exceed 64"


def test_records_of_a_protected_folder_stay_and_so_do_foreign_folders(tmp_path: Path, clock: Clock) -> None:
    protected = old_segment(tmp_path / BOOTS[0], 0, 40 * MEGABYTE, 1000.0)
    (tmp_path / BOOTS[0] / PROTECTED).touch()
    foreign = old_segment(tmp_path / "my flights", 0, 40 * MEGABYTE, 900.0)
    other = old_segment(tmp_path / BOOTS[1], 0, 60 * MEGABYTE, 2000.0)
    ring_in(tmp_path / BOOTS[2], clock).close()
    assert protected.exists() and foreign.exists() and not other.exists()


def test_a_run_folder_with_another_name_has_its_budget_for_itself(tmp_path: Path, clock: Clock) -> None:
    other = old_segment(tmp_path / BOOTS[0], 0, 80 * MEGABYTE, 1000.0)
    ring_in(tmp_path / "run", clock).close()
    assert other.exists()


def test_other_flights_make_room_when_the_disk_is_at_its_floor(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    others = [old_segment(tmp_path / BOOTS[0], n, MEGABYTE, 1000.0 + n) for n in range(3)]

    def usage(_: Path) -> Usage:
        free = 200 * MEGABYTE + 40 * MEGABYTE * sum(not path.exists() for path in others)
        return Usage(100_000 * MEGABYTE, 0, free)

    monkeypatch.setattr(segments.shutil, "disk_usage", usage)
    ring = ring_in(tmp_path / BOOTS[1], clock)
    assert not ring.blocked
    assert [path.exists() for path in others] == [False, False, True]
    ring.close()


def test_the_counts_of_lost_messages_are_recorded_when_the_disk_is_back(
    tmp_path: Path, clock: Clock, disk: Disk
) -> None:
    disk(24, 1)
    ring = ring_in(tmp_path, clock)
    edge = RecorderEdge(ring, MemoryFrameStore(1), ImagePolicy(RecorderSection(frames="none")))
    edge.poll(7)
    for i in range(5):
        edge.on_message(estimate(i, 0.0, 0.0))
    while sum(ring._lost.values()) < 5:
        time.sleep(0.01)
    disk(24, 20)
    clock.now_s += RETRY_S
    edge.on_message(estimate(5, 0.0, 0.0))
    edge.close()
    found = [message for _, _, message in read_flight(tmp_path)]
    (dropped,) = (message for message in found if isinstance(message, m.Dropped))
    assert (dropped.process, dropped.message, dropped.count) == ("recorder", "NavEstimate", 5)
    assert sum(isinstance(message, m.NavEstimate) for message in found) == 1


@pytest.mark.parametrize(("error", "flies"), [(errno.ENOSPC, True), (errno.EROFS, True), (errno.EACCES, False)])
def test_the_supervisor_starts_on_a_broken_disk_and_not_on_a_wrong_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, flies: bool
) -> None:
    monkeypatch.setattr("tempfile.TemporaryFile", failing(error))
    if flies:
        assert _writable(tmp_path / "out") == tmp_path / "out"
    else:
        with pytest.raises(Exception, match="cannot be written"):
            _writable(tmp_path / "out")


def test_a_flipped_bit_never_alters_a_message_and_what_was_left_out_is_named(tmp_path: Path) -> None:
    """At random, and in the opcode of a chunk, which has no checksum."""
    whole = tmp_path / "whole.mcap"
    writer = FlightWriter(whole, header(Config()))
    written: list[m.Message] = []
    for i in range(400):
        written.append(estimate(i, float(i), 0.0))
        writer.write(written[-1], i)
        if i % 20 == 19:
            writer.flush()
    writer.close()
    data, random = whole.read_bytes(), np.random.default_rng(2)
    unaffected, chunk = 0, data.index(b"zstd") - 41  # its length, times, sizes and checksum are before it
    assert data[chunk] == Opcode.CHUNK
    for i in range(68):
        flipped = bytearray(data)
        at = chunk if i < 8 else int(random.integers(len(data)))
        flipped[at] ^= 1 << (i if i < 8 else int(random.integers(8)))
        (tmp_path / "flight.mcap").write_bytes(flipped)
        result = ReadResult()
        found = [message for _, _, message in read_flight(tmp_path / "flight.mcap", result)]
        known = iter(written)
        assert all(message in known for message in found), "in order, and none altered"
        assert len(found) == len(written) or result.damaged or result.truncated_files or result.undecodable
        unaffected += len(found) == len(written)
    assert unaffected > 10


def test_after_a_damaged_chunk_the_rest_of_the_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    writer = FlightWriter(path, header(Config()))
    places = []
    for i in range(5):
        places.append(path.stat().st_size)
        writer.write(frame(i), i)
        writer.flush()
    writer.close()
    data = bytearray(path.read_bytes())
    middle = (places[2] + places[3]) // 2 - 40  # in the compressed messages of frame 2
    data[middle] ^= 0xFF
    path.write_bytes(data)
    result = ReadResult()
    assert frames_of(path, result) == [0, 1, 3, 4]
    (damage,) = result.damaged
    assert damage.startswith(f"flight.mcap, byte {places[2]}: ") and not result.truncated_files
