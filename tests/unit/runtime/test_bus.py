"""Publish and subscribe over ipc, and the live shell on it: late comers, restarts, losses."""

import os
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import pytest
import zmq

from runtime_nodes import ORIGIN
from terrafix import messages as m
from terrafix.core.node import Edge
from terrafix.processes import EVERYTHING, Process
from terrafix.runtime import bus
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.executor import LiveShell
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

pytestmark = pytest.mark.real_time


@pytest.fixture
def context() -> Iterator["zmq.Context[zmq.Socket[bytes]]"]:
    with zmq.Context() as made:
        yield made


@pytest.fixture
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> RunDir:
    return RunDir(tmp_path_factory.mktemp("r"))


def frame(frame_id: int) -> m.Frame:
    return m.Frame(t_ns=frame_id, frame_id=frame_id, file="", width=1, height=1)


def collect(subscriber: Subscriber, publisher: Publisher, until: Callable[[list[m.Message]], bool]) -> list[m.Message]:
    """What arrives, while the publisher serves its new subscribers."""
    got: list[m.Message] = []
    deadline = time.monotonic() + 5
    while not until(got):
        assert time.monotonic() < deadline, f"only {got}"
        publisher.serve()
        subscriber.socket.poll(5)
        got += subscriber.receive()
    return got


def test_late_comers_get_the_origin_and_others_do_not_get_it_twice(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    address = run_dir.address("vision")
    early = Subscriber(context, [address], (m.Origin, m.Frame))  # before there is a publisher
    publisher = Publisher(context, address)
    collect(early, publisher, lambda _: publisher.subscriptions(m.Origin) == 1)
    for message in (ORIGIN, frame(1)):
        publisher.say(message)
    assert collect(early, publisher, lambda got: len(got) == 2) == [ORIGIN, frame(1)]
    late = Subscriber(context, [address], (m.Origin, m.Frame))
    assert collect(late, publisher, bool) == [ORIGIN]
    publisher.say(frame(2))
    assert collect(late, publisher, bool) == [frame(2)], "what is not retained is not said again"
    assert collect(early, publisher, bool) == [frame(2)], "Origin came a second time over the wire and was known"
    assert not early.lost and not late.lost, "a late comer has lost nothing"
    for side in (early, late, publisher):
        side.close()


def test_events_of_processes_are_said_again_while_they_are_news(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    clock_ns = [0]
    publisher = Publisher(context, run_dir.address("supervisor"), clock=lambda: clock_ns[0])
    for second in (0, 15, 16):
        clock_ns[0] = second * 1_000_000_000
        publisher.say(m.ProcessEvent(t_ns=clock_ns[0], process="anchor", event="died"))
    clock_ns[0] = 20_000_000_000
    late = Subscriber(context, [run_dir.address("supervisor")], (m.ProcessEvent,))
    got = collect(late, publisher, lambda got: len(got) == 2)
    assert [e.t_ns for e in got] == [15_000_000_000, 16_000_000_000]
    late.close()
    publisher.close()


def test_a_restarted_publisher_is_found_again_and_its_origin_counts(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    address = run_dir.address("vision")
    subscriber = Subscriber(context, [address], (m.Origin,))
    first = Publisher(context, address)
    first.say(ORIGIN)
    assert collect(subscriber, first, bool) == [ORIGIN]
    first.close()
    started = time.monotonic()
    second = Publisher(context, address)
    second.say(ORIGIN)
    assert collect(subscriber, second, bool) == [ORIGIN]
    assert time.monotonic() - started < 1.0
    subscriber.close()
    second.close()


def test_a_subscriber_that_does_not_read_loses_messages_nobody_waits_and_the_loss_is_counted(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    publisher = Publisher(context, run_dir.address("vision"))
    slow = Subscriber(context, [run_dir.address("vision")], (m.Frame,))
    collect(slow, publisher, lambda _: publisher.subscriptions(m.Frame) == 1)
    total = 6 * bus.QUEUE_LENGTH
    started = time.monotonic()
    for i in range(total):
        publisher.say(frame(i))
    assert time.monotonic() - started < 3, "saying never blocks"
    time.sleep(0.2)
    got = len(list(slow.receive()))
    while more := len(list(slow.receive())):
        got += more
    deadline = time.monotonic() + 10.0
    # A gap shows with the next message that comes through, and there may be more than one.
    while got + slow.lost["Frame"] < total and time.monotonic() < deadline:
        publisher.say(frame(total))
        total += 1
        time.sleep(0.01)
        got += len(list(slow.receive()))
    assert got < total
    assert got + slow.lost["Frame"] == total
    slow.close()
    publisher.close()


class SlowNode:
    """Takes 0.1 s for a Prediction, which it reports."""

    def on(self, message: m.Message) -> Iterable[m.Message]:
        time.sleep(0.1)
        if isinstance(message, m.Prediction):
            yield m.MapMatch(
                t_ns=message.t_ns,
                frame_id=message.frame_id,
                verdict=m.Verdict.ACCEPTED,
                matcher="test",
                mode_e_m=message.step_m[0],
            )

    def tick(self, now_ns: int) -> Iterable[m.Message]:
        return ()


SLOW = Process("slow", "", (m.Prediction,), (m.MapMatch,), 0.0, 1.0, (m.Prediction,))
TALKER = Process("talker", "", (), (m.Prediction,), 0.0, 1.0)
LISTENER = Process("listener", "", EVERYTHING, (), 0.0, 1.0)


def prediction(frame_id: int) -> m.Prediction:
    return m.Prediction(
        t_ns=0,
        frame_id=frame_id,
        p_c_in_w_m=(0.0, 0.0, 0.0),
        q_w_c=(1.0, 0.0, 0.0, 0.0),
        cov=(0.0,) * 36,
        agl_m=1.0,
        agl_sigma_m=1.0,
        step_m=(1.0, 0.0),
        step_cov_m2=(1.0, 0.0, 0.0, 1.0),
    )


def test_a_slow_consumer_takes_the_newest_skips_the_rest_and_says_so(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    table = (SLOW, TALKER, LISTENER)
    progress = Progress.create(run_dir.progress("slow"))
    stop = threading.Event()
    shell = LiveShell(SLOW, table, SlowNode(), None, run_dir, context)
    talker = Publisher(context, run_dir.address("talker"))
    listener = Subscriber(context, [run_dir.address("slow")], EVERYTHING)
    thread = threading.Thread(target=shell.run, args=(stop.is_set,))
    thread.start()
    heard: list[m.Message] = []
    try:
        while not talker.subscriptions(m.Prediction):
            talker.serve()
            time.sleep(0.01)
        time.sleep(0.1)
        for i in range(100):
            talker.say(prediction(i))
            time.sleep(0.015)
        deadline = time.monotonic() + 5
        while not any(isinstance(h, m.MapMatch) and h.frame_id == 99 for h in heard) and time.monotonic() < deadline:
            heard += listener.receive()
            time.sleep(0.01)
        time.sleep(1.2)  # losses are said once a second
    finally:
        stop.set()
        thread.join()
    heard += listener.receive()
    matches = [h for h in heard if isinstance(h, m.MapMatch)]
    assert matches[-1].frame_id == 99
    assert 10 <= len(matches) < 30
    assert sum(h.mode_e_m for h in matches) == 100.0, "the motion of the skipped ones is kept"
    dropped = [h for h in heard if isinstance(h, m.Dropped)]
    assert {(d.process, d.message) for d in dropped} == {("slow", "Prediction")}
    assert sum(d.count for d in dropped) == 100 - len(matches)
    assert progress.stamp_ns > 0 and progress.idle
    for side in (shell, talker, listener, progress):
        side.close()


class TickingNode:
    def __init__(self) -> None:
        self.ticks_ns: list[int] = []

    def on(self, message: m.Message) -> Iterable[m.Message]:
        return ()

    def tick(self, now_ns: int) -> Iterable[m.Message]:
        self.ticks_ns.append(now_ns)
        return ()


class OneWord:
    """An edge that reads one Frame from the world."""

    def __init__(self) -> None:
        self.said = False
        self.heard_from_bus: list[m.Message] = []
        self.closed = False

    def poll(self, now_ns: int) -> Iterable[m.Message]:
        if not self.said:
            self.said = True
            yield frame(1)

    def heard(self, message: m.Message) -> None:
        self.heard_from_bus.append(message)

    def close(self) -> None:
        self.closed = True


def test_ticks_are_steady_and_the_edge_is_polled_and_closed(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    process = Process("ticking", "", (), (m.Frame,), 50.0, 1.0)
    Progress.create(run_dir.progress("ticking")).close()
    node, edge = TickingNode(), OneWord()
    as_edge: Edge = edge
    shell = LiveShell(process, (process,), node, as_edge, run_dir, context)
    until = time.monotonic() + 1.0
    shell.run(lambda: time.monotonic() > until)
    shell.close()
    assert edge.closed
    assert 45 <= len(node.ticks_ns) <= 51
    phases_ms = [((t - node.ticks_ns[0]) / 1e6 + 10) % 20 - 10 for t in node.ticks_ns]
    assert sorted(phases_ms)[len(phases_ms) // 2] < 3, "lateness does not add up"


def test_progress_of_a_process_is_seen_from_outside(tmp_path: Path) -> None:
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


def test_who_comes_while_much_is_said_hears_what_is_retained_first(
    context: "zmq.Context[zmq.Socket[bytes]]", run_dir: RunDir
) -> None:
    """A subscription may come inside of a send: of a thousand such late comers thirty heard a frame before Origin."""
    over = threading.Event()

    def speak() -> None:
        publisher = Publisher(context, run_dir.address("vision"))
        publisher.say(ORIGIN)
        count = 0
        while not over.is_set():
            publisher.say(frame(count := count + 1))
            time.sleep(0)
        publisher.close()

    speaker = threading.Thread(target=speak)
    speaker.start()
    try:
        for _ in range(500):
            late = Subscriber(context, [run_dir.address("vision")], (m.Origin, m.Frame))
            assert late.socket.poll(5000), "nothing was heard"
            assert next(late.receive()) == ORIGIN
            late.socket.close()
    finally:
        over.set()
        speaker.join(10)
