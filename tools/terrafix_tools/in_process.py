"""The driver of nodes in one process: replay, simulation, tests. That of processes is ``terrafix.runtime.executor``.

Two uses. *Messages*: recorded or simulated messages are fed to one node or several. *Lockstep*: nodes with their edges
on the caller's clock, which ``step`` advances."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping

from terrafix.core.clock import Ticker
from terrafix.core.node import Edge, Node
from terrafix.messages import Message
from terrafix.processes import PROCESSES, SOURCE, Process


class InProcessShell:
    """Nodes in one process, one message at a time: deterministic, the same input gives the same output."""

    def __init__(
        self,
        nodes: Mapping[str, Node],
        sink: Callable[[str, Message], None],
        *,
        edges: Mapping[str, Edge] | None = None,
        table: tuple[Process, ...] = PROCESSES,
    ) -> None:
        """``nodes`` and ``edges`` by process name. ``sink(publisher, message)`` gets every message once, in the order
        of delivery; what is fed, or read by an edge, is published by SOURCE.

        Raises ValueError for a node that is not in the process table, and for an edge without a node."""
        self._edges = edges or {}
        self._nodes = [(process, nodes[process.name]) for process in table if process.name in nodes]
        unknown = (set(nodes) | set(self._edges)) - {process.name for process, _ in self._nodes}
        if unknown:
            raise ValueError(f"not in the process table: {', '.join(sorted(unknown))}")
        self._node_of = dict(nodes)
        self._sink = sink
        self._tickers: dict[str, Ticker] = {}

    def feed(self, message: Message) -> None:
        """Delivers ``message`` and all resulting messages, breadth first, to subscribers in table order."""
        self._deliver([(SOURCE, message)])

    def feed_read(self, process: str, message: Message) -> None:
        """Delivers what the edge of ``process`` has read: to all subscribers, then to the node of its own process."""
        self.feed(message)
        self._deliver([(process, answer) for answer in self._node_of[process].on(message)])

    def poll(self, now_ns: int) -> None:
        """Delivers what the edges read now."""
        for name, edge in self._edges.items():
            for message in edge.poll(now_ns):
                self.feed_read(name, message)

    def tick(self, now_ns: int) -> None:
        """Ticks once every node whose period has passed; the first call sets the phase."""
        pending: list[tuple[str, Message]] = []
        for process, node in self._nodes:
            if process.tick_hz > 0:
                ticker = self._tickers.setdefault(process.name, Ticker(process.tick_hz, now_ns))
                if ticker.due(now_ns):
                    pending.extend((process.name, m) for m in node.tick(now_ns))
        self._deliver(pending)

    def step(self, now_ns: int) -> None:
        """Advances the clock: polls the edges, then ticks."""
        self.poll(now_ns)
        self.tick(now_ns)

    def _deliver(self, published: Iterable[tuple[str, Message]]) -> None:
        """Delivers (publisher, message) pairs and all resulting messages until none is left. As in the live shell the
        edge of a process gets what its node receives and publishes."""
        pending = deque(published)
        while pending:
            publisher, message = pending.popleft()
            self._sink(publisher, message)
            for process, node in self._nodes:
                is_own = process.name == publisher
                if is_own or isinstance(message, process.subscribes):
                    if process.name in self._edges:
                        self._edges[process.name].on_message(message)
                    if not is_own:
                        pending.extend((process.name, m) for m in node.on(message))
