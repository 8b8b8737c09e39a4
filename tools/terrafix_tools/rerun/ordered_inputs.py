"""Inputs of a process in the order in which it handled them, from a record in the order of reception."""

from collections import deque
from collections.abc import Iterator

from terrafix.messages import InputOrder, Message
from terrafix.runtime.bus import RETAINED
from terrafix.runtime.input_order import key_of

# A message that an InputOrder names comes to the recorder by another socket, so that it may be recorded after it. The
# queue of the recorder holds about 30 s; a message that is not there after that was lost on the way to the recorder.
LATE_NS = 30_000_000_000
_RETAINED = tuple(RETAINED)


class OrderedInputs:
    """``missing``: number of inputs that the process handled and the record lacks.

    ``undelivered``: number of recorded inputs that the process did not handle: lost on the bus, or it did not run."""

    def __init__(self, process: str) -> None:
        self._process = process
        self._waiting: dict[int, deque[tuple[int, Message]]] = {}  # by key: time of reception, message
        self._arrivals: deque[tuple[int, int]] = deque()  # time of reception, key; oldest first
        self._retained: dict[int, Message] = {}  # the bus sends them again to a restarted process
        self._ordered: deque[tuple[int, int, int]] = deque()  # began_ns, key, time of reception of the InputOrder
        self.missing = 0
        self._forgotten = 0

    @property
    def undelivered(self) -> int:
        return self._forgotten + sum(len(queue) for queue in self._waiting.values())

    def put(self, message: Message, received_ns: int) -> None:
        """Adds a recorded message of a type that the process subscribes to."""
        key = key_of(message)
        if isinstance(message, _RETAINED):
            self._retained[key] = message  # a record repeats the Origin at the start of each segment
            return
        self._waiting.setdefault(key, deque()).append((received_ns, message))
        self._arrivals.append((received_ns, key))

    def order(self, order: InputOrder, received_ns: int) -> None:
        """Adds a recorded InputOrder; one of another process is ignored."""
        if order.process == self._process:
            self._ordered.extend((order.began_ns, key, received_ns) for key in order.inputs)

    def take(self, now_ns: int) -> Iterator[tuple[int, Message]]:
        """-> (began_ns of the instance, message), as far as the record is complete.

        ``now_ns``: time of reception of the newest message of the record."""
        while self._ordered:
            began_ns, key, ordered_ns = self._ordered[0]
            message = self._take_waiting(key)
            if message is None and now_ns - ordered_ns < LATE_NS:
                break
            self._ordered.popleft()
            if message is None:
                self.missing += 1
            else:
                yield began_ns, message
        self._forget(now_ns)

    def finish(self) -> Iterator[tuple[int, Message]]:
        """What is left at the end of the record."""
        if self._ordered:
            yield from self.take(self._ordered[-1][2] + LATE_NS)

    def _take_waiting(self, key: int) -> Message | None:
        if key in self._retained:
            return self._retained[key]
        queue = self._waiting.get(key)
        if not queue:
            return None
        _, message = queue.popleft()
        if not queue:
            del self._waiting[key]
        return message

    def _forget(self, now_ns: int) -> None:
        """Drops messages that no InputOrder has named for twice LATE_NS, to bound the memory."""
        while self._arrivals and now_ns - self._arrivals[0][0] > 2 * LATE_NS:
            received_ns, key = self._arrivals.popleft()
            queue = self._waiting.get(key)
            if queue and queue[0][0] <= received_ns:
                queue.popleft()
                self._forgotten += 1
                if not queue:
                    del self._waiting[key]
