"""The flight record: what is written is read, also after a kill, a cut or a torn tail."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from flight_records import estimate, frame, live_messages, origin, write_record
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.errors import OutputError, SourceError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.recorder.node import QUEUE_LENGTH, RecorderEdge, make_edge
from terrafix.recorder.reader import ReadResult, read_flight, read_thumbnails
from terrafix.recorder.schema import MESSAGE_TYPES, schema_of, topic_of
from terrafix.recorder.segments import MEGABYTE, SegmentRing
from terrafix.recorder.writer import header

pytestmark = pytest.mark.real_time

WRITER = """
import sys, time
from pathlib import Path
from terrafix import messages as m
from terrafix.core.config import Config
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.recorder.node import make_edge
edge = make_edge(NodeContext(Config(), MemoryFrameStore(1), None, Path(sys.argv[1])))
for i in range(100000):
    edge.poll(i)
    edge.heard(m.SourceEnded(t_ns=i, frames=i))
    sys.stdout.write(f"{i}\\n")
    sys.stdout.flush()
    time.sleep(0.002)
"""


def read(path: Path, result: ReadResult | None = None) -> list[m.Message]:
    return [message for _, _, message in read_flight(path, result)]


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    said = live_messages()
    write_record(tmp_path / "flight.mcap", said)
    result = ReadResult()
    assert read(tmp_path, result) == said
    assert result.header["config"]["recorder"]["thumbnails"] is True
    assert result.header["versions"]["python"] == sys.version.split()[0]
    assert result.cut_off == []
    pictures = dict(read_thumbnails(tmp_path))
    assert len(pictures) == 20
    assert pictures[3].startswith(b"\xff\xd8")


def test_a_standard_reader_opens_it_with_schemas_that_viewers_understand(tmp_path: Path) -> None:
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


@pytest.mark.parametrize("share", [0.1, 0.31, 0.5, 0.77, 0.9, 0.995])
def test_a_cut_off_record_reads_up_to_the_cut(tmp_path: Path, share: float) -> None:
    said = live_messages(200)
    whole = tmp_path / "whole.mcap"
    write_record(whole, said)
    data = whole.read_bytes()
    (tmp_path / "flight.mcap").write_bytes(data[: int(len(data) * share)])
    result = ReadResult()
    got = read(tmp_path, result)
    assert got == said[: len(got)]
    assert result.cut_off == [tmp_path / "flight.mcap"]


@pytest.mark.parametrize("tail", [b"\x00" * 4096, b"\xff" * 4096, bytes(range(256)) * 16])
def test_a_torn_tail_costs_only_the_tail(tmp_path: Path, tail: bytes) -> None:
    said = live_messages(200)
    write_record(tmp_path / "whole.mcap", said)
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "flight.mcap").write_bytes(data[: len(data) * 2 // 3] + tail)
    got = read(tmp_path)
    assert got == said[: len(got)]
    assert len(got) > len(said) // 4


def test_kill_9_costs_less_than_a_second(tmp_path: Path) -> None:
    heard: list[tuple[float, int]] = []
    with subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            heard.append((time.monotonic(), int(line)))
            if heard[-1][1] >= 600:
                break
        killed = time.monotonic()
        os.kill(process.pid, signal.SIGKILL)
    got = [x.frames for x in read(tmp_path) if isinstance(x, m.SourceEnded)]
    assert got == list(range(len(got)))
    must_be_there = [i for at, i in heard if at < killed - 0.9]
    assert len(got) >= len(must_be_there)


def test_a_restarted_recorder_goes_on_in_the_next_file(tmp_path: Path) -> None:
    for part in range(2):
        ring = SegmentRing(tmp_path, header(Config()), 64)
        ring.write(frame(part), part)
        ring.close()
    assert [p.name for p in sorted(tmp_path.iterdir())] == ["flight-000.mcap", "flight-001.mcap"]
    assert [x.frame_id for x in read(tmp_path) if isinstance(x, m.Frame)] == [0, 1]


def test_the_ring_keeps_its_budget_and_the_newest(tmp_path: Path) -> None:
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


class StuckRing(SegmentRing):
    """A disk that does not answer until it is let go."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder, header(Config()), 64)
        self.go = threading.Event()

    def write(self, message: m.Message, heard_ns: int) -> None:
        self.go.wait()
        super().write(message, heard_ns)


def test_a_stuck_disk_stops_nobody_and_losses_are_recorded(tmp_path: Path) -> None:
    ring = StuckRing(tmp_path)
    edge = RecorderEdge(ring, MemoryFrameStore(1), None)
    began = time.monotonic()
    for i in range(QUEUE_LENGTH + 500):
        edge.heard(estimate(i, 0.0, 0.0))
    assert time.monotonic() - began < 2.0
    ring.go.set()
    edge.close()
    said = read(tmp_path)
    lost = sum(x.count for x in said if isinstance(x, m.Dropped))
    kept = sum(isinstance(x, m.NavEstimate) for x in said)
    assert 490 <= lost <= 500
    assert kept + lost == QUEUE_LENGTH + 500


def test_frames_get_thumbnails_of_the_configured_width(tmp_path: Path) -> None:
    store = MemoryFrameStore(2)
    store.put(0, np.zeros((480, 640, 3), np.uint8))
    edge = make_edge(NodeContext(Config(), store, None, tmp_path))
    edge.heard(frame(0))
    edge.heard(frame(1))  # its pixels are gone: no thumbnail, no failure
    edge.close()
    pictures = dict(read_thumbnails(tmp_path))
    assert list(pictures) == [0]


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be made"):
        make_edge(NodeContext(Config(), MemoryFrameStore(1), None, tmp_path / "file" / "out"))


def test_a_folder_without_record_says_so(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no flight record"):
        read(tmp_path)
