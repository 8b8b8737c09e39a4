"""The two shells that run nodes: in one process (replay, simulation, tests) and live (one process each, on the bus).

A node does not know which one it is in. The live shell owns what the node may not have: the clock, the sockets, the
edge. One thread: what is slow delays only its own process."""

import gc
import importlib
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping

import msgspec
import zmq

from terrafix.core.clock import Ticker, now_ns
from terrafix.core.node import Edge, Node, NodeContext
from terrafix.messages import Dropped, Message, NavEstimate, Origin, PositionHint, ProcessEvent
from terrafix.processes import OPERATOR, PROCESSES, SOURCE, SUPERVISOR, Process
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.inbox import Inbox
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

EDGE_PERIOD_NS = 10_000_000  # an edge is looked at this often at least; 100 idle turns a second cost 1 % of a core
IDLE_NS = 50_000_000  # a process that waits for messages shows this often that it is not stuck
DROPPED_PERIOD_NS = 1_000_000_000  # losses are said at most this often
HEARERS_WAIT_NS = 20_000_000_000  # the source waits this long for those who must not miss Origin and first frames
STOP_DRAIN_NS = 2_000_000_000  # at a stop, what is queued is still worked on, for at most this long
STOP_QUIET_MS = 100  # nothing more comes when this long nothing came


class InProcessShell:
    """All nodes in one place, one message after the other: the same input gives the same output."""

    def __init__(
        self,
        nodes: Mapping[str, Node],
        sink: Callable[[str, Message], None],
        *,
        table: tuple[Process, ...] = PROCESSES,
    ) -> None:
        """``nodes`` by process name; ``sink(who, message)`` gets every message once, in the order of delivery."""
        self._nodes = [(process, nodes[process.name]) for process in table if process.name in nodes]
        unknown = set(nodes) - {process.name for process, _ in self._nodes}
        if unknown:
            raise ValueError(f"not in the process table: {', '.join(sorted(unknown))}")
        self._sink = sink
        self._tickers: dict[str, Ticker] = {}

    def feed(self, message: Message) -> None:
        """Delivers ``message`` and all that follows from it, breadth first, hearers in table order, until quiet."""
        self._settle(deque([(SOURCE, message)]))

    def tick(self, now_ns: int) -> None:
        """Ticks, once, every node whose period has passed; the first call sets the phase."""
        said: deque[tuple[str, Message]] = deque()
        for process, node in self._nodes:
            if process.tick_hz > 0:
                ticker = self._tickers.setdefault(process.name, Ticker(process.tick_hz, now_ns))
                if ticker.due(now_ns):
                    said.extend((process.name, m) for m in node.tick(now_ns))
        self._settle(said)

    def _settle(self, said: deque[tuple[str, Message]]) -> None:
        while said:
            who, message = said.popleft()
            self._sink(who, message)
            for process, node in self._nodes:
                if process.name != who and isinstance(message, process.subscribes):
                    said.extend((process.name, m) for m in node.on(message))


def run_process(
    name: str,
    ctx: NodeContext,
    endpoints: RunDir,
    *,
    stopping: Callable[[], bool],
    table: tuple[Process, ...] = PROCESSES,
) -> None:
    """Runs the process ``name`` until ``stopping()``. Raises what its node and edge raise: a bug ends the process."""
    process = next(p for p in table if p.name == name)
    module = importlib.import_module(process.module)
    node: Node = module.make_node(ctx)
    make_edge: Callable[[NodeContext], Edge] | None = getattr(module, "make_edge", None)
    edge = make_edge(ctx) if make_edge else None
    gc.freeze()  # what is imported and opened by now lives for ever: collections need not look at it
    with zmq.Context() as context:
        shell = LiveShell(process, table, node, edge, endpoints, context)
        try:
            shell.run(stopping)
        finally:
            shell.close()


class LiveShell:
    """One node on the bus."""

    def __init__(
        self,
        process: Process,
        table: tuple[Process, ...],
        node: Node,
        edge: Edge | None,
        endpoints: RunDir,
        context: zmq.Context[zmq.Socket[bytes]],
    ) -> None:
        self._process = process
        self._endpoints = endpoints
        self._node = node
        self._edge = edge
        # Its own words do not come back to a process: it connects to the others only.
        speakers = [p.name for p in table if p is not process and says_any(p, process.subscribes)]
        if ProcessEvent in process.subscribes:
            speakers.append(SUPERVISOR)
        if PositionHint in process.subscribes:
            speakers.append(OPERATOR)
        opens_source = Origin in process.publishes
        self._hearers = [p.name for p in table if opens_source and Origin in p.subscribes and p is not process]
        self._publisher = Publisher(context, endpoints.address(process.name))
        self._subscriber = Subscriber(context, [endpoints.address(s) for s in speakers], process.subscribes)
        self._inbox = Inbox(process.newest)
        self._progress = Progress(endpoints.progress(process.name))
        self._ticker = Ticker(process.tick_hz, now_ns()) if process.tick_hz > 0 else None
        self._dropped_ticker = Ticker(1e9 / DROPPED_PERIOD_NS, now_ns())
        self._poller = zmq.Poller()
        self._poller.register(self._subscriber.socket, zmq.POLLIN)
        self._poller.register(self._publisher.socket, zmq.POLLIN)

    def run(self, stopping: Callable[[], bool]) -> None:
        self._progress.stamp(now_ns())
        self._wait_for_hearers(stopping)
        while not stopping():
            self._progress.begin()
            worked = self._turn()
            self._progress.stamp(now_ns(), len(self._inbox))
            if not worked:
                self._wait()
        self._drain()

    def close(self) -> None:
        if self._edge is not None:
            self._edge.close()
        self._publisher.close()
        self._subscriber.close()
        self._progress.close()

    def _turn(self) -> bool:
        """One tick if due, one look at the edge, one message. True when there was something to do."""
        worked = False
        now = now_ns()
        if self._ticker is not None and self._ticker.due(now):
            self._say(self._node.tick(now))
        if self._edge is not None:
            for message in self._edge.poll(now):
                worked = True
                if isinstance(message, Origin):
                    self._endpoints.set_epoch(message.t_ns)
                self._publisher.say(message)
                self._say(self._node.on(message))
        return self._hear() or worked

    def _hear(self) -> bool:
        self._publisher.serve()
        for message in self._subscriber.receive():
            self._inbox.put(message)
        self._say_dropped()
        next_message = self._inbox.take()
        if next_message is None:
            return False
        if self._edge is not None:
            self._edge.heard(next_message)
        self._say(self._node.on(next_message))
        return True

    def _say(self, messages: Iterable[Message]) -> None:
        for message in messages:
            if isinstance(message, NavEstimate):  # a node has no clock to say when it spoke
                message = msgspec.structs.replace(message, emitted_at_ns=now_ns())
            if self._edge is not None:
                self._edge.heard(message)  # first: what is sent to the autopilot does not wait for the bus
            self._publisher.say(message)

    def _say_dropped(self) -> None:
        lost, skipped = self._subscriber.lost, self._inbox.skipped
        if not (lost or skipped) or not self._dropped_ticker.due(now_ns()):
            return
        counts: Counter[str] = lost + skipped
        lost.clear()
        skipped.clear()
        now = now_ns()
        self._say(Dropped(t_ns=now, process=self._process.name, message=k, count=n) for k, n in counts.items())

    def _wait(self) -> None:
        """Until the next message, or until there is something else to do."""
        now = now_ns()
        until = now + (IDLE_NS if self._edge is None else EDGE_PERIOD_NS)
        if self._ticker is not None:
            until = min(until, self._ticker.next_ns)
        if until > now:
            self._poller.poll(-((now - until) // 1_000_000))  # rounded up: too early would be a turn for nothing

    def _wait_for_hearers(self, stopping: Callable[[], bool]) -> None:
        """Whoever opens the source says Origin once and then frames: those who need them connect first. All are
        started together; who opens a large map, or builds the engine of a model, takes longer."""
        until = now_ns() + HEARERS_WAIT_NS
        while self._missing_hearers() > 0 and now_ns() < until and not stopping():
            self._publisher.serve()
            self._poller.poll(10)
            self._progress.stamp(now_ns())

    def _missing_hearers(self) -> int:
        living = sum(not self._endpoints.gave_up(name).exists() for name in self._hearers)
        return living - self._publisher.subscriptions(Origin)

    def _drain(self) -> None:
        until = now_ns() + STOP_DRAIN_NS
        while now_ns() < until and (self._hear() or self._subscriber.socket.poll(STOP_QUIET_MS)):
            self._progress.stamp(now_ns(), len(self._inbox))


def says_any(process: Process, kinds: tuple[type[Message], ...]) -> bool:
    """Dropped is said by the shell, so by every process."""
    return Dropped in kinds or any(kind in kinds for kind in process.publishes)
