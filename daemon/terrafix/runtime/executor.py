"""The shell that runs a node live: one process each, on the bus.

Nodes run unchanged in one process as well (replay, simulation, tests). The live shell owns the clock, the sockets and
the edge, which a node may not have. It has a single thread, so that a slow node delays only its own process."""

import gc
import importlib
from collections import Counter
from collections.abc import Callable, Iterable

import msgspec
import zmq

from terrafix.core import logs
from terrafix.core.allocator import RETURN_S, return_free_memory
from terrafix.core.clock import Ticker, now_ns
from terrafix.core.log_lines import MessageLog
from terrafix.core.node import Edge, Node, NodeContext
from terrafix.messages import Dropped, InputOrder, LogLine, Message, NavEstimate, Origin, PositionHint, ProcessEvent
from terrafix.processes import OPERATOR, PROCESSES, SUPERVISOR, Process
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.inbox import Inbox
from terrafix.runtime.input_order import InputLog
from terrafix.runtime.progress_stamp import Progress
from terrafix.runtime.run_dir import RunDir

EDGE_PERIOD_NS = 10_000_000  # longest interval between polls of an edge; 100 idle polls a second take 1 % of a core
IDLE_STAMP_NS = 50_000_000  # longest interval between progress stamps of a process that waits for messages
DROPPED_PERIOD_NS = 1_000_000_000  # shortest interval between reports of lost messages
SUBSCRIBERS_WAIT_NS = 20_000_000_000  # longest wait of the source for the subscribers of Origin and the first frames
# Longest wait of a started process for the recorder's subscription (RECONNECT_MS and a turn of its loop): what is
# published before it is used by others, and missing in the record.
RECORDER_WAIT_NS = 200_000_000
STOP_DRAIN_NS = 2_000_000_000  # at a stop, queued messages are still processed for at most this long
STOP_QUIET_MS = 100  # the queues count as empty after this long without a message


def run_process(
    name: str,
    ctx: NodeContext,
    endpoints: RunDir,
    *,
    stopping: Callable[[], bool],
    table: tuple[Process, ...] = PROCESSES,
) -> None:
    """Runs the process ``name`` until ``stopping()``. Exceptions of node and edge propagate and end the process."""
    process = next(p for p in table if p.name == name)
    module = importlib.import_module(process.module)
    node: Node = module.make_node(ctx)
    make_edge: Callable[[NodeContext], Edge] | None = getattr(module, "make_edge", None)
    edge = make_edge(ctx) if make_edge else None
    gc.freeze()  # objects created until now live until the end, so that garbage collection need not scan them
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
        # A process does not receive its own messages: it connects to the other publishers only.
        publishers = [p.name for p in table if p is not process and publishes_any(p, process.subscribes)]
        if ProcessEvent in process.subscribes:
            publishers.append(SUPERVISOR)
        if PositionHint in process.subscribes:
            publishers.append(OPERATOR)
        opens_source = Origin in process.publishes
        # The subscribers that the process which opens the source waits for before it starts.
        self._required = [p.name for p in table if opens_source and Origin in p.subscribes and p is not process]
        self._is_recorded = any(InputOrder in p.subscribes and p is not process for p in table)
        self._publisher = Publisher(context, endpoints.address(process.name))
        self._subscriber = Subscriber(context, [endpoints.address(s) for s in publishers], process.subscribes)
        self._inbox = Inbox(process.newest)
        self._inputs = InputLog(process.name, now_ns()) if InputOrder in process.publishes else None
        self._message_log = MessageLog()
        self._progress = Progress(endpoints.progress(process.name))
        self._ticker = Ticker(process.tick_hz, now_ns()) if process.tick_hz > 0 else None
        self._dropped_ticker = Ticker(1e9 / DROPPED_PERIOD_NS, now_ns())
        self._memory_ticker = Ticker(1.0 / RETURN_S, now_ns() + round(1e9 * RETURN_S))
        self._poller = zmq.Poller()
        self._poller.register(self._subscriber.socket, zmq.POLLIN)
        self._poller.register(self._publisher.socket, zmq.POLLIN)

    def run(self, stopping: Callable[[], bool]) -> None:
        """Runs until ``stopping()``, then processes the queued messages for at most STOP_DRAIN_NS."""
        self._progress.stamp(now_ns())
        self._wait_for_recorder(stopping)
        self._wait_for_subscribers(stopping)
        while not stopping():
            self._progress.begin()
            worked = self._step()
            self._progress.stamp(now_ns(), len(self._inbox))
            if not worked:
                if self._memory_ticker.due(now_ns()):  # now, when nothing waits for this process
                    return_free_memory()
                self._wait()
        self._drain()

    def close(self) -> None:
        if self._edge is not None:
            self._edge.close()
        self._publisher.close()
        self._subscriber.close()
        self._progress.close()

    def _step(self) -> bool:
        """One tick if due, one poll of the edge, one queued message. False: there was nothing to do."""
        worked = False
        now = now_ns()
        if self._ticker is not None and self._ticker.due(now):
            self._publish(self._node.tick(now))
        if self._edge is not None:
            for message in self._edge.poll(now):
                worked = True
                if isinstance(message, Origin):
                    self._endpoints.set_epoch(message.t_ns)
                self._publisher.publish(message)
                logs.write(self._message_log.entry(message))
                self._publish(self._node.on(message))
        return self._process_next() or worked

    def _process_next(self) -> bool:
        """Receives messages and passes the oldest queued one to edge and node. False: none is queued."""
        self._publisher.serve()
        for message in self._subscriber.receive():
            self._inbox.put(message)
        self._publish_losses()
        self._publish_log_lines()
        next_message = self._inbox.take()
        if next_message is None:
            return False
        if self._edge is not None:
            self._edge.on_message(next_message)
        if self._inputs is not None:
            self._inputs.add(next_message)
            if self._inputs.full:
                self._publish_input_order()
        self._publish(self._node.on(next_message))
        return True

    def _publish(self, messages: Iterable[Message]) -> None:
        """Passes the messages of the node to the edge, to the bus and to the log."""
        for message in messages:
            self._publish_input_order()  # before the output, so that a record with an output has its inputs
            if isinstance(message, NavEstimate):  # set here because a node has no clock
                message = msgspec.structs.replace(message, emitted_at_ns=now_ns())
            if self._edge is not None:
                self._edge.on_message(message)  # before the bus, so that output to the autopilot is not delayed
            self._publisher.publish(message)
            logs.write(self._message_log.entry(message))

    def _publish_input_order(self) -> None:
        order = None if self._inputs is None else self._inputs.take(now_ns())
        if order is not None:
            self._publisher.publish(order)

    def _publish_losses(self) -> None:
        """Publishes Dropped for lost and skipped messages, at most once per DROPPED_PERIOD_NS."""
        lost, skipped = self._subscriber.lost, self._inbox.skipped
        if not (lost or skipped) or not self._dropped_ticker.due(now_ns()):
            return
        counts: Counter[str] = lost + skipped
        lost.clear()
        skipped.clear()
        now = now_ns()
        self._publish(Dropped(t_ns=now, process=self._process.name, message=k, count=n) for k, n in counts.items())

    def _publish_log_lines(self, *, last: bool = False) -> None:
        """Publishes what this process has logged beside its messages, so that it is in the record."""
        for line in logs.take_lines(last=last):
            message = LogLine(process=self._process.name, **line)
            if self._edge is not None:
                self._edge.on_message(message)  # the edge of the recorder writes those of its own process
            self._publisher.publish(message)

    def _wait(self) -> None:
        """Waits for a message, at most until the next tick or poll of the edge is due."""
        now = now_ns()
        until = now + (IDLE_STAMP_NS if self._edge is None else EDGE_PERIOD_NS)
        if self._ticker is not None:
            until = min(until, self._ticker.next_ns)
        if until > now:
            self._poller.poll(-((now - until) // 1_000_000))  # ms, rounded up: to wake up early would be useless

    def _wait_for_recorder(self, stopping: Callable[[], bool]) -> None:
        """The process that subscribes to InputOrder is the recorder; an observer such as `terrafix status` does not."""
        until = now_ns() + (RECORDER_WAIT_NS if self._is_recorded else 0)
        while self._publisher.subscriptions(InputOrder) == 0 and now_ns() < until and not stopping():
            self._publisher.serve()
            self._poller.poll(1)

    def _wait_for_subscribers(self, stopping: Callable[[], bool]) -> None:
        """The process that opens the source publishes Origin once and then frames, so their subscribers must connect
        first. All processes start together; to open a large map or to build the engine of a model takes longer."""
        until = now_ns() + SUBSCRIBERS_WAIT_NS
        while self._missing_subscribers() > 0 and now_ns() < until and not stopping():
            self._publisher.serve()
            self._poller.poll(10)
            self._progress.stamp(now_ns())

    def _missing_subscribers(self) -> int:
        expected = sum(not self._endpoints.gave_up(name).exists() for name in self._required)
        return expected - self._publisher.subscriptions(Origin)

    def _drain(self) -> None:
        """Processes queued messages until no more arrive, for at most STOP_DRAIN_NS."""
        until = now_ns() + STOP_DRAIN_NS
        while now_ns() < until and (self._process_next() or self._subscriber.socket.poll(STOP_QUIET_MS)):
            self._progress.stamp(now_ns(), len(self._inbox))
        self._publish_log_lines(last=True)
        self._publish_input_order()


def publishes_any(process: Process, kinds: tuple[type[Message], ...]) -> bool:
    """Whether ``process`` publishes one of ``kinds``. Its shell publishes Dropped and LogLine."""
    return any(kind in kinds for kind in (Dropped, LogLine, *process.publishes))
