"""The flight record: written messages are read back, also after a kill, a truncation or corruption of the end."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader

from flight_records import estimate, frame, live_messages, origin, write_record
from terrafix import messages as m
from terrafix.core.config import Config, RecorderSection
from terrafix.core.errors import OutputError, SourceError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import Edge, NodeContext
from terrafix.recorder.images import ImagePolicy
from terrafix.recorder.node import RECORD_QUEUE_LENGTH, RecorderEdge, make_edge
from terrafix.recorder.provenance import header
from terrafix.recorder.reader import ReadResult, read_flight, read_frame_images, read_thumbnails
from terrafix.recorder.schema import MESSAGE_TYPES, schema_of, topic_of
from terrafix.recorder.segments import MEGABYTE, SegmentRing
from terrafix.recorder.writer import FlightWriter
from terrafix_tools.log.edit import cut
from terrafix_tools.report.data import FlightView
from terrafix_tools.report.sections_run import provenance

pytestmark = pytest.mark.real_time

WRITER = """
import sys, time
from pathlib import Path
from terrafix import messages as m
from terrafix.core.config import Config, RecorderSection
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.recorder.node import make_edge
edge = make_edge(NodeContext(Config(), MemoryFrameStore(1), None, Path(sys.argv[1])))
for i in range(100000):
    edge.poll(i)
    edge.on_message(m.SourceEnded(t_ns=i, frames=i))
    sys.stdout.write(f"{i}\\n")
    sys.stdout.flush()
    time.sleep(0.002)
"""


def odometry(i: int, *, becomes_keyframe: bool) -> m.Odometry:
    return m.Odometry(t_ns=i, frame_id=i, keyframe_id=0, verdict=m.Verdict.ACCEPTED, becomes_keyframe=becomes_keyframe)


def edge_on(folder: Path, store: MemoryFrameStore | None = None, **recorder: Any) -> Edge:
    """``recorder``: keys of its configuration."""
    config = Config(recorder=RecorderSection(**recorder))
    return make_edge(NodeContext(config, store or MemoryFrameStore(1), None, folder))


def read(path: Path, result: ReadResult | None = None) -> list[m.Message]:
    return [message for _, _, message in read_flight(path, result)]


def test_without_a_flush_no_more_than_128_kb_are_missing_after_a_kill(tmp_path: Path) -> None:
    """As the outputs state it; mcap keeps the open chunk in memory."""
    writer = FlightWriter(tmp_path / "flight.mcap", {})
    for i in range(40):
        writer.write(m.LogLine(t_ns=i, process="link", level="info", event=os.urandom(4096).hex()), i)
    on_disk = tmp_path / "killed.mcap"
    on_disk.write_bytes((tmp_path / "flight.mcap").read_bytes())
    assert len(read(on_disk)) >= 40 - 18  # 16 fill a chunk; a part of the one before is in the buffer of the file
    writer.close()


def test_recorded_messages_are_read_back(tmp_path: Path) -> None:
    messages = live_messages()
    write_record(tmp_path / "flight.mcap", messages)
    result = ReadResult()
    assert read(tmp_path, result) == messages
    assert result.header["config"]["recorder"]["frames"] == "thumbnails"
    assert result.header["versions"]["python"] == sys.version.split()[0]
    assert result.truncated_files == []
    pictures = dict(read_thumbnails(tmp_path))
    assert len(pictures) == 20
    assert pictures[3].startswith(b"\xff\xd8")


def test_every_segment_and_the_report_have_what_the_source_says(tmp_path: Path) -> None:
    said = m.SourceFacts(t_ns=5, facts=(m.Fact("clock", "by arrival"), m.Fact("height", "not stated")))
    ring = SegmentRing(tmp_path, header(Config()), budget_mb=100)
    for message in (origin(), said):
        ring.write(message, 5)
    ring.write(estimate(1, 0.0, 0.0), 10**15)  # far later: the next one begins
    ring.close()
    for name in ("flight-000.mcap", "flight-001.mcap"):
        result = ReadResult()
        assert said in read(tmp_path / name, result)
        assert result.header["source"] == [["clock", "by arrival"], ["height", "not stated"]]
    assert cut(tmp_path, tmp_path / "cut.mcap", 1.0, 1e9) == 2
    assert read(tmp_path / "cut.mcap").count(said) == 1
    page = provenance(FlightView(title="", rows=[], frame_ids=[], header=result.header))
    assert "source, clock" in page and "by arrival" in page


def test_a_standard_mcap_reader_opens_the_record_with_json_schemas(tmp_path: Path) -> None:
    write_record(tmp_path / "flight.mcap", live_messages())
    with (tmp_path / "flight.mcap").open("rb") as stream:
        found = {}
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            found[channel.topic] = (schema.name, json.loads(message.data))
    assert found["/nav_estimate"][0] == "terrafix.NavEstimate"
    assert found["/nav_estimate"][1]["lat_deg"] == pytest.approx(48.0, abs=0.01)
    assert found["/thumbnail"][0] == "foxglove.CompressedImage"


@pytest.mark.parametrize("message_type", MESSAGE_TYPES.values(), ids=lambda t: t.__name__)
def test_every_message_has_a_plain_schema(message_type: type[m.Message]) -> None:
    def plain(node: dict[str, object]) -> None:
        assert node["type"] in ("object", "array", "string", "number", "integer", "boolean")
        if node["type"] == "array":
            assert isinstance(node["items"], dict)
            assert node["items"]["type"] != "array"
            plain(node["items"])
        for child in node.get("properties", {}).values():  # type: ignore[attr-defined]
            plain(child)

    schema = json.loads(schema_of(message_type))
    plain(schema)
    assert "t_ns" in schema["properties"]
    assert topic_of(message_type).startswith("/")


@pytest.mark.parametrize(
    ("share", "tail"),
    [
        *((share, b"") for share in (0.1, 0.31, 0.5, 0.77, 0.9, 0.995)),
        *((2 / 3, tail) for tail in (b"\x00" * 4096, b"\xff" * 4096, bytes(range(256)) * 16)),
    ],
)
def test_a_truncated_record_with_a_corrupt_tail_is_read_up_to_its_end(
    tmp_path: Path, share: float, tail: bytes
) -> None:
    messages = live_messages(200)
    write_record(tmp_path / "whole.mcap", messages)
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "flight.mcap").write_bytes(data[: int(len(data) * share)] + tail)
    result = ReadResult()
    read_back = read(tmp_path, result)
    assert read_back == messages[: len(read_back)]
    assert len(read_back) > len(messages) // 4 or not tail
    assert tail or result.truncated_files == [tmp_path / "flight.mcap"]


def test_kill_9_loses_less_than_a_second_of_the_record(tmp_path: Path) -> None:
    written: list[tuple[float, int]] = []
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            written.append((time.monotonic(), int(line)))
            if written[-1][1] >= 600:
                break
        killed = time.monotonic()
        os.kill(process.pid, signal.SIGKILL)
    read_back = [x.frames for x in read(tmp_path) if isinstance(x, m.SourceEnded)]
    assert read_back == list(range(len(read_back)))
    must_be_there = [i for at, i in written if at < killed - 0.9]
    assert len(read_back) >= len(must_be_there)


def test_a_restarted_recorder_continues_in_the_next_file(tmp_path: Path) -> None:
    for part in range(2):
        ring = SegmentRing(tmp_path, header(Config()), 64)
        ring.write(frame(part), part)
        ring.close()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["flight-000.mcap", "flight-001.mcap"]
    assert [x.frame_id for x in read(tmp_path) if isinstance(x, m.Frame)] == [0, 1]


def test_the_ring_of_record_files_keeps_its_budget_and_the_newest_messages(tmp_path: Path) -> None:
    ring = SegmentRing(tmp_path, header(Config()), 1)
    ring.write(origin(), 0)
    noise = np.random.default_rng(1)
    for i in range(600):
        ring.write_thumbnail(i, i, noise.bytes(6000))
        ring.write(frame(i), i)
        ring.flush()
    ring.close()
    sizes = [p.stat().st_size for p in tmp_path.glob("*.mcap")]
    assert sum(sizes) <= 1.1 * MEGABYTE
    kept = [x for x in read(tmp_path) if isinstance(x, m.Frame)]
    assert kept[-1].frame_id == 599
    assert kept[0].frame_id > 100
    for file in tmp_path.glob("*.mcap"):  # each file is readable alone
        result = ReadResult()
        assert any(isinstance(x, m.Origin) for x in read(file, result))
        assert result.header["format"].startswith("terrafix-flight/")


class BlockedRing(SegmentRing):
    """A disk whose writes block until ``unblock`` is set."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, header(Config()), 64)
        self.unblock = threading.Event()

    def write(self, message: m.Message, received_ns: int) -> None:
        self.unblock.wait()
        super().write(message, received_ns)


def test_a_blocked_disk_does_not_block_the_recorder_and_losses_are_recorded(tmp_path: Path) -> None:
    ring = BlockedRing(tmp_path)
    edge = RecorderEdge(ring, MemoryFrameStore(1), ImagePolicy(RecorderSection(frames="none")))
    began = time.monotonic()
    for i in range(RECORD_QUEUE_LENGTH + 500):
        edge.on_message(estimate(i, 0.0, 0.0))
    assert time.monotonic() - began < 2.0
    ring.unblock.set()
    edge.close()
    messages = read(tmp_path)
    lost = sum(x.count for x in messages if isinstance(x, m.Dropped))
    kept = sum(isinstance(x, m.NavEstimate) for x in messages)
    assert 490 <= lost <= 500
    assert kept + lost == RECORD_QUEUE_LENGTH + 500


def test_frames_get_thumbnails_unless_their_pixels_are_gone(tmp_path: Path) -> None:
    store = MemoryFrameStore(2)
    store.put(0, np.zeros((480, 640, 3), np.uint8))
    edge = edge_on(tmp_path, store)
    edge.on_message(frame(0))
    edge.on_message(frame(1))  # its pixels are not in the store: no thumbnail and no error
    edge.close()
    pictures = dict(read_thumbnails(tmp_path))
    assert list(pictures) == [0]


@pytest.mark.parametrize(("frames", "at_full_size"), [("thumbnails", []), ("keyframes", [1]), ("all", [0, 1])])
def test_frames_are_recorded_at_full_size_as_configured(tmp_path: Path, frames: Any, at_full_size: list[int]) -> None:
    store = MemoryFrameStore(2)
    images = [np.full((48, 64, 3), shade, np.uint8) for shade in (40, 90)]
    edge = edge_on(tmp_path, store, frames=frames, frame_format="jpeg")
    for i, image in enumerate(images):
        store.put(i, image)
        edge.on_message(frame(i))
        edge.on_message(odometry(i, becomes_keyframe=i == 1))
    edge.close()
    found = {image.frame_id: (image.image_format, image.data) for image in read_frame_images(tmp_path)}
    assert sorted(found) == at_full_size
    for frame_id, (form, data) in found.items():
        assert form == "jpeg"
        shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert np.abs(shown.astype(int) - images[frame_id]).max() <= 2
    assert list(dict(read_thumbnails(tmp_path))) == [0, 1]


def test_keyframe_whose_pixels_are_gone_is_counted_as_lost(tmp_path: Path) -> None:
    edge = edge_on(tmp_path, frames="keyframes")
    edge.on_message(odometry(0, becomes_keyframe=True))
    edge.on_message(odometry(1, becomes_keyframe=False))
    edge.close()
    (lost,) = (message for message in read(tmp_path) if isinstance(message, m.Dropped))
    assert (lost.process, lost.message, lost.count) == ("recorder", "frame image", 1)


def test_without_images_frames_have_no_thumbnails(tmp_path: Path) -> None:
    store = MemoryFrameStore(1)
    store.put(0, np.zeros((48, 64, 3), np.uint8))
    edge = edge_on(tmp_path, store, frames="none")
    edge.on_message(frame(0))
    edge.close()
    assert not list(read_thumbnails(tmp_path)) and not list(read_frame_images(tmp_path))


def test_an_output_folder_that_cannot_be_created_is_a_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be made"):
        edge_on(tmp_path / "file" / "out")


def test_a_folder_without_flight_record_is_a_source_error(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no flight record"):
        read(tmp_path)
