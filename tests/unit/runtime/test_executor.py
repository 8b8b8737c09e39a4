"""The in-process shell, the inbox, the clock and the codec: pure, so exact."""

from collections.abc import Iterable

import msgspec
import numpy as np
import pytest

from runtime_nodes import ORIGIN
from terrafix import messages as m
from terrafix.core import codec
from terrafix.core.clock import Ticker
from terrafix.processes import EVERYTHING, PROCESSES, SOURCE, Process
from terrafix.runtime.executor import InProcessShell
from terrafix.runtime.inbox import Inbox


def frame(frame_id: int) -> m.Frame:
    return m.Frame(t_ns=frame_id, frame_id=frame_id, file="", width=1, height=1)


def verdict(frame_id: int, measurement: str) -> m.MeasurementVerdict:
    return m.MeasurementVerdict(t_ns=0, frame_id=frame_id, measurement=measurement, verdict=m.Verdict.ACCEPTED)


def prediction(frame_id: int, east_m: float, north_m: float) -> m.Prediction:
    return m.Prediction(
        t_ns=frame_id,
        frame_id=frame_id,
        p_c_in_w_m=(0.0, 0.0, 100.0),
        q_w_c=(1.0, 0.0, 0.0, 0.0),
        cov=(1.0,) * 36,
        agl_m=100.0,
        agl_sigma_m=2.0,
        step_m=(east_m, north_m),
        step_cov_m2=(1.0, 0.5, 0.5, 2.0),
    )


def status(now_ns: int) -> m.LinkStatus:
    return m.LinkStatus(
        t_ns=now_ns, connected=False, autopilot="none", sysid=1, sent=0, received=0, bad=0, time_offset_ms=None
    )


class Teller:
    """Answers every message that it hears with its own name, and every tick with a status."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.heard: list[str] = []

    def on(self, message: m.Message) -> Iterable[m.Message]:
        self.heard.append(type(message).__name__)
        if isinstance(message, m.Frame):
            yield verdict(message.frame_id, self.name)

    def tick(self, now_ns: int) -> Iterable[m.Message]:
        yield status(now_ns)


TABLE = (
    Process("first", "", (m.Frame, m.MeasurementVerdict), (m.MeasurementVerdict,), 10.0, 1.0),
    Process("second", "", (m.Frame, m.MeasurementVerdict), (m.MeasurementVerdict,), 0.0, 1.0),
    Process("listener", "", EVERYTHING, (), 0.0, 1.0),
)


def test_messages_go_breadth_first_in_table_order_and_through_the_sink_once() -> None:
    said: list[tuple[str, str]] = []
    nodes = {name: Teller(name) for name in ("listener", "second", "first")}  # order of the dict does not matter
    shell = InProcessShell(nodes, lambda who, message: said.append((who, type(message).__name__)), table=TABLE)
    shell.feed(frame(7))
    both = [("first", "MeasurementVerdict"), ("second", "MeasurementVerdict"), ("listener", "MeasurementVerdict")]
    assert said == [(SOURCE, "Frame"), *both]
    assert nodes["first"].heard == ["Frame", "MeasurementVerdict", "MeasurementVerdict"], "not its own word"
    assert nodes["listener"].heard == ["Frame", "MeasurementVerdict", "MeasurementVerdict"]


def test_ticks_come_at_the_rate_of_the_table_and_only_where_there_is_one() -> None:
    said: list[tuple[str, int]] = []
    nodes = {"first": Teller("first"), "second": Teller("second")}
    shell = InProcessShell(nodes, lambda who, message: said.append((who, message.t_ns)), table=TABLE)
    for now_ms in (0, 50, 99, 100, 450, 460, 500):
        shell.tick(now_ms * 1_000_000)
    assert said == [("first", ms * 1_000_000) for ms in (0, 100, 450, 500)], "late ticks are not made up for"


def test_the_same_input_gives_the_same_bytes() -> None:
    def fly() -> list[bytes]:
        record: list[bytes] = []
        nodes = {name: Teller(name) for name in ("first", "second", "listener")}
        shell = InProcessShell(nodes, lambda who, msg: record.append(who.encode() + codec.encode(msg)), table=TABLE)
        for i in range(20):
            shell.feed(frame(i))
            shell.tick(i * 30_000_000)
        return record

    assert fly() == fly()


def test_a_node_that_the_table_does_not_know_is_an_error() -> None:
    with pytest.raises(ValueError, match="not in the process table: foo"):
        InProcessShell({"foo": Teller("foo")}, lambda *_: None, table=TABLE)


def test_every_message_that_is_said_is_heard_and_recorded() -> None:
    recorded = set(next(p for p in PROCESSES if p.name == "recorder").subscribes)
    assert recorded == set(m.AnyMessage.__args__)
    for process in PROCESSES:
        assert set(process.newest) <= set(process.subscribes)


def test_ticker_keeps_an_absolute_grid() -> None:
    ticker = Ticker(50.0, 1000)
    assert ticker.due(1000) and not ticker.due(1000)
    assert ticker.due(1000 + 27_000_000), "late by 7 ms"
    assert ticker.next_ns == 1000 + 40_000_000, "the next one is not late"
    assert ticker.due(1000 + 130_000_000)
    assert ticker.next_ns == 1000 + 140_000_000, "missed ticks are skipped"


def test_only_the_newest_prediction_is_worked_on_and_no_motion_is_lost() -> None:
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


def test_a_full_inbox_loses_the_oldest_and_counts_but_keeps_the_origin() -> None:
    inbox = Inbox(capacity=3)
    inbox.put(ORIGIN)
    for i in range(5):
        inbox.put(frame(i))
    assert inbox.skipped == {"Frame": 3}
    assert [inbox.take() for _ in range(4)] == [ORIGIN, frame(3), frame(4), None]


def test_codec_round_trip_of_numbers_enums_and_absence() -> None:
    estimate = prediction(3, 0.1 + 0.2, -0.0)
    for message in (estimate, verdict(1, "höhe"), ORIGIN, status(2**62)):
        assert codec.decode(codec.encode(message)) == message
        assert codec.decode_json(codec.encode_json(message)) == message


def test_codec_takes_numpy_scalars_and_refuses_other_things() -> None:
    odd = msgspec.structs.replace(prediction(np.int64(3), np.float64(0.1), np.float32(0.5)))  # type: ignore[arg-type]
    assert codec.decode(codec.encode(odd)) == prediction(3, 0.1, 0.5)
    with pytest.raises(TypeError, match="ndarray cannot be part of a message"):
        codec.encode(msgspec.structs.replace(odd, cov=np.zeros(36)))
    with pytest.raises(msgspec.ValidationError):
        codec.decode(msgspec.msgpack.encode({"type": "Unknown", "t_ns": 0}))
