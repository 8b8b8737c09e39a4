"""A command on this computer as a client on the bus of a run: it publishes messages and receives the replies."""

import time
from collections.abc import Iterator

import zmq

from terrafix.messages import Message
from terrafix.processes import OPERATOR
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.run_dir import RunDir

POLL_MS = 20


class Operator:
    """Publisher and subscriber of an operator's command. A context manager; at most one at a time per run."""

    def __init__(self, run_dir: RunDir, *, replies: type[Message], replier: str) -> None:
        """``replies``: message type to receive, published by the process ``replier``."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._publisher = Publisher(self._context, run_dir.address(OPERATOR))
        self._subscriber = Subscriber(self._context, [run_dir.address(replier)], (replies,))

    def __enter__(self) -> "Operator":
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.close()
        self._publisher.close()
        self._context.term()

    def wait_for_subscribers(self, kind: type[Message], count: int, wait_s: float) -> bool:
        """Waits until ``count`` processes subscribe to messages of type ``kind``. False: not within ``wait_s``."""
        until = time.monotonic() + wait_s
        while self._publisher.subscriptions(kind) < count and time.monotonic() < until:
            self._publisher.socket.poll(POLL_MS)
            self._publisher.serve()
        return self._publisher.subscriptions(kind) >= count

    def publish(self, message: Message) -> None:
        self._publisher.publish(message)

    def replies(self, wait_s: float) -> Iterator[Message]:
        """Yields the replies as they arrive, for ``wait_s``."""
        until = time.monotonic() + wait_s
        while time.monotonic() < until:
            self._subscriber.socket.poll(POLL_MS)
            yield from self._subscriber.receive()
