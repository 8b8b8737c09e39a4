"""The source edge: real-time playback, newest frame first, restart, end of the source."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from source_folders import flight, picture, source_of
from terrafix import messages as m
from terrafix.core.clock import now_ns
from terrafix.core.config import Config, HealthSection, SourceSection
from terrafix.core.errors import SourceError, UsageError
from terrafix.core.frames import MemoryFrameStore
from terrafix.core.node import NodeContext
from terrafix.vision.edge import SourceEdge, make_edge
from terrafix.vision.frame_rate import FrameRateLimit
from terrafix.vision.sources import Shot, Source, open_source
from terrafix.vision.sources.facts import facts_of

pytestmark = pytest.mark.real_time


class Listener:
    """Polls an edge until a condition holds, as the process loop does."""

    def __init__(self, edge: SourceEdge) -> None:
        self.edge = edge
        self.messages: list[m.Message] = []
        self.heard_ns: dict[int, int] = {}

    def until(self, true: Callable[[], bool], limit_s: float = 10.0) -> None:
        end_ns = now_ns() + round(limit_s * 1e9)
        while not true():
            assert now_ns() < end_ns, f"never happened; messages: {[type(x).__name__ for x in self.messages]}"
            for message in self.edge.poll(now_ns()):
                self.messages.append(message)
                if isinstance(message, m.Frame):
                    self.heard_ns[message.frame_id] = now_ns()
            time.sleep(0.002)

    @property
    def frames(self) -> list[m.Frame]:
        return [x for x in self.messages if isinstance(x, m.Frame)]

    def ended(self) -> bool:
        return any(isinstance(x, m.SourceEnded) for x in self.messages)


Listen = Callable[..., Listener]


@pytest.fixture
def listen() -> Iterator[Listen]:
    """``listen(flight folder or source, epoch_ns, realtime, **of_SourceEdge)``: to an edge that the test closes."""
    listeners: list[Listener] = []

    def start(source: Path | Source, epoch_ns: int | None = None, realtime: bool = True, **more: Any) -> Listener:
        opened = open_source(str(source)) if isinstance(source, Path) else source
        store = more.pop("store", MemoryFrameStore())
        listeners.append(Listener(SourceEdge(opened, store, epoch_ns, realtime, **more)))
        return listeners[-1]

    yield start
    for listener in listeners:
        listener.edge.close()


def test_a_recording_plays_in_real_time(tmp_path: Path, listen: Listen) -> None:
    listener = listen(flight(tmp_path / "f", 4, step_s=0.1))
    listener.until(listener.ended)
    assert isinstance(listener.messages[0], m.Origin)
    zero_ns = listener.messages[0].t_ns
    assert [f.t_ns - zero_ns for f in listener.frames] == [i * 100_000_000 for i in range(4)]
    for frame in listener.frames:
        assert listener.heard_ns[frame.frame_id] >= frame.t_ns  # not before its time
    states = [x for x in listener.messages if isinstance(x, m.VehicleState)]
    assert [s.t_ns for s in states] == [f.t_ns for f in listener.frames]
    assert listener.messages[-1].frames == 4  # type: ignore[attr-defined]
    assert list(listener.edge.poll(now_ns())) == []  # the end is published once


def test_what_the_source_says_of_itself_is_published_after_its_origin(tmp_path: Path, listen: Listen) -> None:
    source = open_source(str(flight(tmp_path / "f", 4)))
    listener = listen(source)
    listener.until(lambda: len(listener.messages) > 1)
    origin, said = listener.messages[:2]
    assert isinstance(said, m.SourceFacts) and said.t_ns == origin.t_ns
    assert said.facts == tuple(facts_of(source)) and {"camera", "rate"} <= {fact.topic for fact in said.facts}


def test_a_restart_resumes_at_the_current_flight_time(tmp_path: Path, listen: Listen) -> None:
    epoch_ns = now_ns() - 550_000_000
    listener = listen(flight(tmp_path / "f", 12, step_s=0.1), epoch_ns)
    listener.until(listener.ended)
    assert listener.messages[0].t_ns == epoch_ns
    ids = [f.frame_id for f in listener.frames]
    assert ids[0] >= 6 and ids == list(range(ids[0], 12))
    assert [f.t_ns - epoch_ns for f in listener.frames] == [i * 100_000_000 for i in ids]


def test_a_restart_after_the_end_publishes_the_end(tmp_path: Path, listen: Listen) -> None:
    listener = listen(flight(tmp_path / "f", 3, step_s=0.1), now_ns() - 10**10)
    listener.until(listener.ended)
    assert listener.frames == [] and listener.messages[-1].frames == 3  # type: ignore[attr-defined]


def test_the_newest_frame_is_delivered_and_dropped_frames_are_published_with_an_error(
    tmp_path: Path, listen: Listen
) -> None:
    listener = listen(flight(tmp_path / "f", 10, step_s=0.02))
    listener.until(lambda: len(listener.frames) >= 1)
    time.sleep(0.7)  # vision is busy with the first frame
    listener.until(listener.ended)
    assert [f.frame_id for f in listener.frames] == list(range(10))
    whole = [f.frame_id for f in listener.frames if not f.error]
    assert whole == [0, 9]
    assert {f.error for f in listener.frames} == {"", m.OVERTAKEN}
    times = [x.t_ns for x in listener.messages[1:-1]]
    assert times == sorted(times)


def test_an_exception_in_the_reader_thread_ends_the_process(listen: Listen) -> None:
    listener = listen(source_of(lambda: 1 / 0))
    with pytest.raises(ZeroDivisionError):
        listener.until(lambda: False)


def test_frame_ids_of_a_camera_increase_over_a_restart(listen: Listen) -> None:
    frames = (m.Frame(t_ns=now_ns(), frame_id=i, file="", width=320, height=240) for i in range(2))
    store = MemoryFrameStore()
    camera = source_of(lambda: (Shot(frame, (), picture(frame.frame_id)) for frame in frames))
    listener = listen(camera, now_ns() - 5 * 10**9, store=store)
    listener.until(listener.ended)
    first, second = (f.frame_id for f in listener.frames)
    assert first >= 5000 and second == first + 1
    assert store.get(second) is not None
    assert abs(now_ns() - listener.frames[0].t_ns) < 5 * 10**9  # camera times are already on the monotonic clock


def test_make_edge_reads_the_configuration(tmp_path: Path) -> None:
    def context(**source: str) -> NodeContext:
        config = Config(source=SourceSection(**source))  # type: ignore[arg-type]
        return NodeContext(config=config, frames=MemoryFrameStore(), map_path=None, out_dir=tmp_path)

    folder = str(flight(tmp_path / "f"))
    edge = make_edge(context(path=folder, start="10,20"))
    assert edge is not None
    origin, _ = edge.poll(now_ns())
    edge.close()
    assert isinstance(origin, m.Origin) and (origin.lat_deg, origin.lon_deg) == (10.0, 20.0)
    with pytest.raises(UsageError):
        make_edge(context(path=folder, start="here"))
    with pytest.raises(SourceError, match="no source given"):
        make_edge(context())


@pytest.mark.parametrize(("own", "expected_m"), [(None, 612.0), (40.0, 40.0)])
def test_the_ground_height_of_the_map_is_the_default_for_a_source_without_one(
    tmp_path: Path, listen: Listen, own: float | None, expected_m: float
) -> None:
    source = open_source(str(flight(tmp_path / "f")))
    known = msgspec.structs.replace(source.origin(), ground_amsl_m=own)
    source.origin = lambda: known  # type: ignore[method-assign]
    listener = listen(source, None, False, ground_amsl_m=612.0)
    listener.until(listener.ended)
    assert isinstance(listener.messages[0], m.Origin) and listener.messages[0].ground_amsl_m == expected_m


@pytest.mark.parametrize(("step_s", "realtime", "every"), [(0.05, True, 4), (60.0, False, 1)])
def test_in_a_hot_computer_frames_above_the_rate_are_left_out_in_real_time_and_their_telemetry_is_not(
    tmp_path: Path, listen: Listen, step_s: float, realtime: bool, every: int
) -> None:
    limit = FrameRateLimit(HealthSection(hot_rate_hz=5.0))
    listener = listen(flight(tmp_path / "f", 20, step_s=step_s), realtime=realtime, rate=limit)
    listener.edge.on_message(
        m.Health(t_ns=0, band=m.ThermalBand.HOT, temperature_c=85.0, throttled=False, disk_free_mb=None, cause="test")
    )
    listener.until(listener.ended)
    assert [(f.frame_id, f.error) for f in listener.frames] == [(i, "") for i in range(0, 20, every)]
    assert len([x for x in listener.messages if isinstance(x, m.VehicleState)]) == 20
    assert listener.messages[-1].frames == 20  # type: ignore[attr-defined]


def test_a_recording_that_is_not_played_in_real_time_is_read_whole_in_a_hot_computer(
    tmp_path: Path, listen: Listen
) -> None:
    limit = FrameRateLimit(HealthSection(hot_rate_hz=5.0))
    limit.band = m.ThermalBand.HOT
    listener = listen(flight(tmp_path / "f", 12, step_s=0.05), realtime=False, rate=limit)
    listener.until(listener.ended)
    assert len(listener.frames) == 12
