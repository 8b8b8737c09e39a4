"""A program on this computer that reads the bus of a run and publishes nothing."""

from collections.abc import Iterable

import zmq

from terrafix.messages import Dropped, InputOrder, LogLine, Message, Origin
from terrafix.processes import SUPERVISOR, Process
from terrafix.runtime.bus import Subscriber
from terrafix.runtime.run_dir import RunDir

# Processes count the subscriptions to these to learn that the recorder, or all that need the Origin, are connected.
COUNTED: tuple[type[Message], ...] = (InputOrder, Origin)


class Observer:
    """Messages of the types ``kinds`` (none of COUNTED) from all processes of ``table``. A context manager. If it stops
    reading, the publishers drop what does not fit into its queue, and nothing waits for it."""

    def __init__(self, run_dir: RunDir, kinds: Iterable[type[Message]], table: Iterable[Process]) -> None:
        wanted = tuple(kinds)
        assert not set(wanted) & set(COUNTED), "an observer must not be counted as the recorder"
        names = [p.name for p in table if {Dropped, LogLine, *p.publishes} & set(wanted)]
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        addresses = [run_dir.address(name) for name in (*names, SUPERVISOR)]
        self._subscriber = Subscriber(self._context, addresses, wanted)

    def __enter__(self) -> "Observer":
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.close()
        self._context.term()

    def receive(self, wait_ms: int) -> list[Message]:
        """The messages that have arrived, after a wait of at most ``wait_ms`` for the first."""
        self._subscriber.socket.poll(wait_ms)
        return list(self._subscriber.receive())
