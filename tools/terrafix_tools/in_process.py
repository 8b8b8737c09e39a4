"""The shell that runs nodes in one process: replay, simulation, tests. The live one is in ``terrafix.runtime``."""

from collections import deque
from collections.abc import Callable, Mapping

from terrafix.core.clock import Ticker
from terrafix.core.node import Node
from terrafix.messages import Message
from terrafix.processes import PROCESSES, SOURCE, Process


class InProcessShell:
    """All nodes in one process, one message at a time: deterministic, the same input gives the same output."""

    def __init__(
        self,
        nodes: Mapping[str, Node],
        sink: Callable[[str, Message], None],
        *,
        table: tuple[Process, ...] = PROCESSES,
    ) -> None:
        """``nodes`` by process name. ``sink(publisher, message)`` gets every message once, in the order of delivery.

        Raises ValueError for a node that is not in the process table."""
        self._nodes = [(process, nodes[process.name]) for process in table if process.name in nodes]
        unknown = set(nodes) - {process.name for process, _ in self._nodes}
        if unknown:
            raise ValueError(f"not in the process table: {', '.join(sorted(unknown))}")
        self._sink = sink
        self._tickers: dict[str, Ticker] = {}

    def feed(self, message: Message) -> None:
        """Delivers ``message`` and all resulting messages, breadth first, to subscribers in table order."""
        self._deliver(deque([(SOURCE, message)]))

    def tick(self, now_ns: int) -> None:
        """Ticks once every node whose period has passed; the first call sets the phase."""
        pending: deque[tuple[str, Message]] = deque()
        for process, node in self._nodes:
            if process.tick_hz > 0:
                ticker = self._tickers.setdefault(process.name, Ticker(process.tick_hz, now_ns))
                if ticker.due(now_ns):
                    pending.extend((process.name, m) for m in node.tick(now_ns))
        self._deliver(pending)

    def _deliver(self, pending: deque[tuple[str, Message]]) -> None:
        """Delivers (publisher, message) pairs and all resulting messages until the queue is empty."""
        while pending:
            publisher, message = pending.popleft()
            self._sink(publisher, message)
            for process, node in self._nodes:
                if process.name != publisher and isinstance(message, process.subscribes):
                    pending.extend((process.name, m) for m in node.on(message))
