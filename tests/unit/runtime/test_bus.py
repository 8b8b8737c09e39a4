"""Publish/subscribe over ipc, and the live shell on it: late subscribers, restarts, losses."""

import io
import json
import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq

from gps_messages import GPS
from runtime_nodes import ORIGIN, frame, prediction
from terrafix import messages as m
from terrafix.core import logs
from terrafix.core.node import Edge, Node, NodeBase
from terrafix.processes import Process
from terrafix.runtime.bus import BUS_QUEUE_LENGTH, Publisher, Subscriber
from terrafix.runtime.executor import LiveShell
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

pytestmark = pytest.mark.real_time


Context = zmq.Context[zmq.Socket[bytes]]


class Bus:
    """Publishers and subscribers of a run, which the fixture closes."""

    def __init__(self, context: Context, run_dir: RunDir) -> None:
        self.context, self.run_dir = context, run_dir
        self._open: list[Publisher | Subscriber] = []

    def publisher(self, process: str, **options: Any) -> Publisher:
        publisher = Publisher(self.context, self.run_dir.address(process), **options)
        self._open.append(publisher)
        return publisher

    def subscriber(self, process: str, *kinds: type[m.Message]) -> Subscriber:
        subscriber = Subscriber(self.context, [self.run_dir.address(process)], kinds)
        self._open.append(subscriber)
        return subscriber

    def shell(self, process: Process, others: tuple[Process, ...], node: Node, edge: Edge | None = None) -> LiveShell:
        Progress.create(self.run_dir.progress(process.name)).close()
        return LiveShell(process, (process, *others), node, edge, self.run_dir, self.context)

    def close(self) -> None:
        for side in self._open:
            side.close()


@pytest.fixture
def bus(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    with zmq.Context() as context:
        bus = Bus(context, RunDir(tmp_path_factory.mktemp("r")))
        yield bus
        bus.close()


def collect(subscriber: Subscriber, publisher: Publisher, until: Callable[[list[m.Message]], bool]) -> list[m.Message]:
    """Messages that arrive while the publisher serves its new subscribers."""
    got: list[m.Message] = []
    deadline = time.monotonic() + 5
    while not until(got):
        assert time.monotonic() < deadline, f"only {got}"
        publisher.serve()
        subscriber.socket.poll(5)
        got += subscriber.receive()
    return got


def test_late_subscribers_get_the_retained_origin_and_others_do_not_get_it_twice(bus: Bus) -> None:
    early = bus.subscriber("vision", m.Origin, m.Frame)  # before there is a publisher
    publisher = bus.publisher("vision")
    collect(early, publisher, lambda _: publisher.subscriptions(m.Origin) == 1)
    for message in (ORIGIN, frame(1)):
        publisher.publish(message)
    assert collect(early, publisher, lambda got: len(got) == 2) == [ORIGIN, frame(1)]
    late = bus.subscriber("vision", m.Origin, m.Frame)
    assert collect(late, publisher, bool) == [ORIGIN]
    publisher.publish(frame(2))
    assert collect(late, publisher, bool) == [frame(2)], "messages that are not retained are not sent again"
    assert collect(early, publisher, bool) == [frame(2)], "the second Origin is discarded by its sequence number"
    assert not early.lost and not late.lost, "messages before the subscription are not losses"


def test_process_events_are_retained_for_ten_seconds(bus: Bus) -> None:
    clock_ns = [0]
    publisher = bus.publisher("supervisor", clock=lambda: clock_ns[0])
    for second in (0, 15, 16):
        clock_ns[0] = second * 1_000_000_000
        publisher.publish(m.ProcessEvent(t_ns=clock_ns[0], process="anchor", event="died"))
    clock_ns[0] = 20_000_000_000
    late = bus.subscriber("supervisor", m.ProcessEvent)
    got = collect(late, publisher, lambda got: len(got) == 2)
    assert [e.t_ns for e in got] == [15_000_000_000, 16_000_000_000]


def test_gps_input_is_retained_until_the_recorder_has_subscribed(bus: Bus) -> None:
    publisher = bus.publisher("link")
    status = bus.subscriber("link", m.GpsInput)  # of another program, which is not the recorder
    collect(status, publisher, lambda _: publisher.subscriptions(m.GpsInput) == 1)
    early = [msgspec.structs.replace(GPS, t_ns=t_ns) for t_ns in (1, 2)]
    for gps in early:
        publisher.publish(gps)
    recorder = bus.subscriber("link", m.GpsInput, m.InputOrder)
    assert collect(recorder, publisher, lambda got: len(got) == 2) == early
    collect(recorder, publisher, lambda _: publisher.subscriptions(m.InputOrder) == 1)
    later = msgspec.structs.replace(GPS, t_ns=3)
    publisher.publish(later)
    assert collect(recorder, publisher, bool) == [later]
    assert collect(status, publisher, lambda got: len(got) == 3) == [*early, later]
    restarted = bus.subscriber("link", m.GpsInput, m.InputOrder)
    assert later not in collect(restarted, publisher, lambda got: len(got) == 2)


def test_subscribers_reconnect_to_a_restarted_publisher_and_receive_its_origin(bus: Bus) -> None:
    subscriber = bus.subscriber("vision", m.Origin)
    first = bus.publisher("vision")
    first.publish(ORIGIN)
    assert collect(subscriber, first, bool) == [ORIGIN]
    first.close()
    started = time.monotonic()
    second = bus.publisher("vision")
    second.publish(ORIGIN)
    assert collect(subscriber, second, bool) == [ORIGIN]
    assert time.monotonic() - started < 1.0


def test_messages_lost_by_a_slow_subscriber_are_counted_and_publishing_does_not_block(bus: Bus) -> None:
    publisher = bus.publisher("vision")
    slow = bus.subscriber("vision", m.Frame)
    collect(slow, publisher, lambda _: publisher.subscriptions(m.Frame) == 1)
    total = 6 * BUS_QUEUE_LENGTH
    started = time.monotonic()
    for i in range(total):
        publisher.publish(frame(i))
    assert time.monotonic() - started < 3, "publishing does not block"
    time.sleep(0.2)
    got = len(list(slow.receive()))
    while more := len(list(slow.receive())):
        got += more
    deadline = time.monotonic() + 10.0
    # A gap is detected with the next message that arrives, and there may be several gaps.
    while got + slow.lost["Frame"] < total and time.monotonic() < deadline:
        publisher.publish(frame(total))
        total += 1
        time.sleep(0.01)
        got += len(list(slow.receive()))
    assert got < total
    assert got + slow.lost["Frame"] == total


class SlowNode(NodeBase):
    """Takes 0.1 s for a Prediction and publishes a MapMatch for it."""

    def on(self, message: m.Message) -> Iterable[m.Message]:
        time.sleep(0.1)
        if isinstance(message, m.Prediction):
            yield m.MapMatch(
                t_ns=message.t_ns,
                frame_id=message.frame_id,
                verdict=m.Verdict.ACCEPTED,
                matcher="test",
                place=m.MatchPlace(e_m=message.step_m[0], n_m=0.0, mass=1.0),
            )


SLOW = Process("slow", "", (m.Prediction,), (m.MapMatch,), 0.0, 1.0, (m.Prediction,))
PUBLISHER = Process("publisher", "", (), (m.Prediction,), 0.0, 1.0)
LISTENER = Process("listener", "", m.ALL_MESSAGES, (), 0.0, 1.0)


@pytest.mark.slow
def test_a_slow_process_handles_the_newest_prediction_and_reports_the_skipped_ones(bus: Bus) -> None:
    stop = threading.Event()
    shell = bus.shell(SLOW, (PUBLISHER, LISTENER), SlowNode())
    progress = Progress(bus.run_dir.progress("slow"))
    publisher = bus.publisher("publisher")
    listener = bus.subscriber("slow", *m.ALL_MESSAGES)
    thread = threading.Thread(target=shell.run, args=(stop.is_set,))
    thread.start()
    received: list[m.Message] = []
    try:
        while not publisher.subscriptions(m.Prediction):
            publisher.serve()
            time.sleep(0.01)
        time.sleep(0.1)
        for i in range(100):
            publisher.publish(prediction(i, 1.0, 0.0))
            time.sleep(0.015)
        deadline = time.monotonic() + 5
        while not any(isinstance(h, m.MapMatch) and h.frame_id == 99 for h in received) and time.monotonic() < deadline:
            received += listener.receive()
            time.sleep(0.01)
        time.sleep(1.2)  # losses are published once a second
    finally:
        stop.set()
        thread.join()
    received += listener.receive()
    matches = [h for h in received if isinstance(h, m.MapMatch)]
    assert matches[-1].frame_id == 99
    assert 10 <= len(matches) < 30
    assert sum(h.place.e_m for h in matches if h.place) == 100.0, (
        "the merged predictions contain the motion of the skipped ones"
    )
    dropped = [h for h in received if isinstance(h, m.Dropped)]
    assert {(d.process, d.message) for d in dropped} == {("slow", "Prediction")}
    assert sum(d.count for d in dropped) == 100 - len(matches)
    assert progress.stamp_ns > 0 and progress.idle
    shell.close()
    progress.close()


class TickingNode(NodeBase):
    def __init__(self) -> None:
        self.ticks_ns: list[int] = []

    def tick(self, now_ns: int) -> Iterable[m.Message]:
        self.ticks_ns.append(now_ns)
        return ()


class OneFrameEdge:
    """An edge that reads one Frame."""

    def __init__(self) -> None:
        self.done = False
        self.received: list[m.Message] = []
        self.closed = False

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        if not self.done:
            self.done = True
            yield frame(1)

    def on_message(self, message: m.Message) -> None:
        self.received.append(message)

    def close(self) -> None:
        self.closed = True


def test_ticks_keep_the_time_grid_and_the_edge_is_polled_and_closed(bus: Bus) -> None:
    node, edge = TickingNode(), OneFrameEdge()
    shell = bus.shell(Process("ticking", "", (), (m.Frame,), 50.0, 1.0), (), node, edge)
    until = time.monotonic() + 1.0
    shell.run(lambda: time.monotonic() > until)
    shell.close()
    assert edge.closed
    assert 45 <= len(node.ticks_ns) <= 51
    phases_ms = [((t - node.ticks_ns[0]) / 1e6 + 10) % 20 - 10 for t in node.ticks_ns]
    assert sorted(phases_ms)[len(phases_ms) // 2] < 3, "delays do not accumulate"


def test_progress_stamps_are_visible_in_another_mapping(tmp_path: Path) -> None:
    outside = Progress.create(tmp_path / "p")
    inside = Progress(tmp_path / "p")
    assert outside.stamp_ns == 0
    inside.begin()
    assert not outside.idle
    inside.stamp(2**60, queued=3)
    assert (outside.stamp_ns, outside.idle) == (2**60, False)
    inside.stamp(2**60 + 1)
    assert outside.idle
    outside.reset()
    assert outside.stamp_ns == 0
    inside.close()
    outside.close()


def test_addresses_are_short_enough_for_unix_sockets() -> None:
    longest = RunDir(Path("/dev/shm/terrafix-abcdefgh")).address("supervisor").removeprefix("ipc://")
    assert len(os.fsencode(longest)) < 107


def test_a_subscriber_that_joins_a_busy_stream_receives_retained_messages_first(bus: Bus) -> None:
    """A subscription may arrive during a send: without XPUB_MANUAL thirty of a thousand late subscribers received a
    frame before Origin."""
    over = threading.Event()

    def publish_frames() -> None:
        publisher = bus.publisher("vision")
        publisher.publish(ORIGIN)
        count = 0
        while not over.is_set():
            publisher.publish(frame(count := count + 1))
            time.sleep(0)
        publisher.close()

    thread = threading.Thread(target=publish_frames)
    thread.start()
    try:
        for _ in range(500):
            late = bus.subscriber("vision", m.Origin, m.Frame)
            assert late.socket.poll(5000), "no message was received"
            assert next(late.receive()) == ORIGIN
            late.socket.close()
    finally:
        over.set()
        thread.join(10)


@pytest.mark.parametrize("late_s", [0.05, None], ids=["a late recorder", "no recorder"])
def test_a_started_process_waits_for_the_recorder_so_that_its_first_message_is_recorded(
    bus: Bus, late_s: float | None
) -> None:
    shell = bus.shell(Process("started", "", (), (m.Frame,), 0.0, 1.0), (LISTENER,), TickingNode(), OneFrameEdge())
    over = threading.Event()
    began_s = time.monotonic()
    thread = threading.Thread(target=shell.run, args=(over.is_set,))
    thread.start()
    try:
        time.sleep(late_s or 0.5)
        recorder = bus.subscriber("started", m.Frame, m.InputOrder)
        arrived = recorder.socket.poll(1000)
        assert [*recorder.receive()] == ([frame(1)] if late_s else []), "without a recorder it goes on"
        assert not late_s or (arrived and time.monotonic() - began_s < 1.0)
        recorder.close()
    finally:
        over.set()
        thread.join(10)
        shell.close()


class LoggingEdge(OneFrameEdge):
    """An edge that logs what no message says, and reads a frame without pixels."""

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        if not self.done:
            self.done = True
            logs.get().warning("camera lost", source="/dev/video0")
            yield msgspec.structs.replace(frame(1), error="no answer")


def test_lines_of_the_log_that_no_message_says_are_published_and_those_of_messages_are_not(bus: Bus) -> None:
    stream = io.StringIO()
    writer = logs.configure("INFO", "logging", stream)
    edge = LoggingEdge()
    shell = bus.shell(Process("logging", "", (), (m.Frame,), 0.0, 1.0), (LISTENER,), TickingNode(), edge)
    until = time.monotonic() + 0.6
    shell.run(lambda: time.monotonic() > until)
    shell.close()
    writer.close()
    (line,) = (message for message in edge.received if isinstance(message, m.LogLine))
    assert (line.process, line.level, line.event) == ("logging", "warning", "camera lost")
    assert line.fields["source"] == "/dev/video0"
    events = [json.loads(text)["event"] for text in stream.getvalue().splitlines()]
    assert events == ["camera lost", "no image"], "both are in the journal"
