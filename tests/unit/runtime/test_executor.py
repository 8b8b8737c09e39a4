"""The in-process shell, the inbox, the ticker and the codec. They are deterministic, so results are exact."""

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from runtime_nodes import ORIGIN, frame, prediction, status
from terrafix import messages as m
from terrafix.core import codec
from terrafix.core.clock import Ticker
from terrafix.processes import PROCESSES, SOURCE, Process
from terrafix.runtime.inbox import Inbox
from terrafix_tools.in_process import InProcessShell


def verdict(frame_id: int, measurement: str) -> m.MeasurementVerdict:
    return m.MeasurementVerdict(t_ns=0, frame_id=frame_id, measurement=measurement, verdict=m.Verdict.ACCEPTED)


class ReplyingNode:
    """Publishes a verdict with its name for every Frame, and a status at every tick."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.received: list[str] = []

    def on(self, message: m.Message) -> Iterable[m.Message]:
        self.received.append(type(message).__name__)
        if isinstance(message, m.Frame):
            yield verdict(message.frame_id, self.name)

    def tick(self, now_ns: int) -> Iterable[m.Message]:
        yield status(now_ns)


TABLE = (
    Process("first", "", (m.Frame, m.MeasurementVerdict), (m.MeasurementVerdict,), 10.0, 1.0),
    Process("second", "", (m.Frame, m.MeasurementVerdict), (m.MeasurementVerdict,), 0.0, 1.0),
    Process("listener", "", m.ALL_MESSAGES, (), 0.0, 1.0),
)


def test_messages_are_delivered_breadth_first_in_table_order_and_reach_the_sink_once() -> None:
    sunk: list[tuple[str, str]] = []
    nodes = {name: ReplyingNode(name) for name in ("listener", "second", "first")}  # the order has no effect
    shell = InProcessShell(nodes, lambda who, message: sunk.append((who, type(message).__name__)), table=TABLE)
    shell.feed(frame(7))
    both = [("first", "MeasurementVerdict"), ("second", "MeasurementVerdict"), ("listener", "MeasurementVerdict")]
    assert sunk == [(SOURCE, "Frame"), *both]
    assert nodes["first"].received == ["Frame", "MeasurementVerdict", "MeasurementVerdict"], "not its own message"
    assert nodes["listener"].received == ["Frame", "MeasurementVerdict", "MeasurementVerdict"]


def test_ticks_have_the_rate_of_the_process_table() -> None:
    sunk: list[tuple[str, int]] = []
    nodes = {"first": ReplyingNode("first"), "second": ReplyingNode("second")}
    shell = InProcessShell(nodes, lambda who, message: sunk.append((who, message.t_ns)), table=TABLE)
    for now_ms in (0, 50, 99, 100, 450, 460, 500):
        shell.tick(now_ms * 1_000_000)
    assert sunk == [("first", ms * 1_000_000) for ms in (0, 100, 450, 500)], "missed ticks are skipped"


def test_the_same_input_gives_the_same_bytes() -> None:
    def fly() -> list[bytes]:
        record: list[bytes] = []
        nodes = {name: ReplyingNode(name) for name in ("first", "second", "listener")}
        shell = InProcessShell(nodes, lambda who, msg: record.append(who.encode() + codec.encode(msg)), table=TABLE)
        for i in range(20):
            shell.feed(frame(i))
            shell.tick(i * 30_000_000)
        return record

    assert fly() == fly()


def test_a_node_outside_the_process_table_is_an_error() -> None:
    with pytest.raises(ValueError, match="not in the process table: foo"):
        InProcessShell({"foo": ReplyingNode("foo")}, lambda *_: None, table=TABLE)


class CountingEdge:
    """Reads one Frame at each poll, and keeps what it is given."""

    def __init__(self) -> None:
        self.given: list[str] = []

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        yield frame(now_ns)

    def on_message(self, message: m.Message) -> None:
        self.given.append(type(message).__name__)

    def close(self) -> None:
        """Nothing is open."""


def test_in_lockstep_an_edge_feeds_its_own_node_and_gets_what_that_receives_and_publishes() -> None:
    sunk: list[tuple[str, str]] = []
    nodes, edge = {name: ReplyingNode(name) for name in ("first", "listener")}, CountingEdge()
    table = (Process("first", "", (m.Origin,), (m.MeasurementVerdict,), 10.0, 1.0), TABLE[2])
    shell = InProcessShell(
        nodes, lambda who, message: sunk.append((who, type(message).__name__)), edges={"first": edge}, table=table
    )
    shell.feed(ORIGIN)
    shell.step(0)
    read, answered, ticked = (SOURCE, "Frame"), ("first", "MeasurementVerdict"), ("first", "LinkStatus")
    assert sunk == [(SOURCE, "Origin"), read, ("listener", "MeasurementVerdict"), answered, ticked]
    assert nodes["first"].received == ["Origin", "Frame"], "what its edge has read, though it does not subscribe to it"
    assert nodes["listener"].received == ["Origin", "Frame", "MeasurementVerdict", "LinkStatus"]
    assert edge.given == ["Origin", "MeasurementVerdict", "LinkStatus"], "not what it has read itself"


def test_an_edge_without_its_node_is_an_error() -> None:
    with pytest.raises(ValueError, match="not in the process table: first"):
        InProcessShell({}, lambda *_: None, edges={"first": CountingEdge()}, table=TABLE)


def test_the_recorder_subscribes_to_every_message_type() -> None:
    recorded = set(next(p for p in PROCESSES if p.name == "recorder").subscribes)
    assert recorded == set(m.ALL_MESSAGES)
    for process in PROCESSES:
        assert set(process.newest) <= set(process.subscribes)


def test_the_ticker_keeps_an_absolute_time_grid() -> None:
    ticker = Ticker(50.0, 1000)
    assert ticker.due(1000) and not ticker.due(1000)
    assert ticker.due(1000 + 27_000_000), "late by 7 ms"
    assert ticker.next_ns == 1000 + 40_000_000, "the next deadline stays on the grid"
    assert ticker.due(1000 + 130_000_000)
    assert ticker.next_ns == 1000 + 140_000_000, "missed ticks are skipped"


def test_queued_predictions_are_merged_into_the_newest_without_loss_of_motion() -> None:
    inbox = Inbox(newest=(m.Prediction,))
    inbox.put(ORIGIN)
    for i, (east_m, north_m) in enumerate([(1.0, 2.0), (10.0, 20.0), (100.0, 200.0)]):
        inbox.put(prediction(i, east_m, north_m))
    assert inbox.take() == ORIGIN
    newest = inbox.take()
    assert isinstance(newest, m.Prediction)
    assert newest.frame_id == 2
    assert newest.step_m == (111.0, 222.0)
    assert newest.step_cov_m2 == (3.0, 1.5, 1.5, 6.0)
    assert inbox.take() is None
    assert inbox.skipped == {"Prediction": 2}


def odometry(frame_id: int, *, keyframe: bool = False) -> m.Odometry:
    return m.Odometry(
        t_ns=frame_id, frame_id=frame_id, keyframe_id=0, verdict=m.Verdict.ACCEPTED, becomes_keyframe=keyframe
    )


def test_queued_odometry_gives_way_to_a_newer_frame_unless_it_is_of_a_keyframe() -> None:
    inbox = Inbox(newest=(m.Odometry,))
    waiting = [odometry(1), odometry(2, keyframe=True), odometry(3), frame(3), odometry(4), odometry(5)]
    for message in waiting:
        inbox.put(message)
    assert [inbox.take() for _ in range(4)] == [odometry(2, keyframe=True), frame(3), odometry(5), None]
    assert inbox.skipped == {"Odometry": 3}


def test_a_full_inbox_drops_and_counts_the_oldest_messages_except_the_origin() -> None:
    inbox = Inbox(capacity=3)
    inbox.put(ORIGIN)
    for i in range(5):
        inbox.put(frame(i))
    assert inbox.skipped == {"Frame": 3}
    assert [inbox.take() for _ in range(4)] == [ORIGIN, frame(3), frame(4), None]


def test_codec_round_trip_of_numbers_enums_and_none() -> None:
    estimate = prediction(3, 0.1 + 0.2, -0.0)
    for message in (estimate, verdict(1, "höhe"), ORIGIN, status(2**62)):
        assert codec.decode(codec.encode(message)) == message


def test_codec_accepts_numpy_scalars_and_rejects_arrays_and_unknown_types() -> None:
    odd = msgspec.structs.replace(prediction(np.int64(3), np.float64(0.1), np.float32(0.5)))  # type: ignore[arg-type]
    assert codec.decode(codec.encode(odd)) == prediction(3, 0.1, 0.5)
    with pytest.raises(TypeError, match="ndarray cannot be part of a message"):
        codec.encode(msgspec.structs.replace(odd, cov=np.zeros(36)))
    with pytest.raises(msgspec.ValidationError):
        codec.decode(msgspec.msgpack.encode({"type": "Unknown", "t_ns": 0}))
