"""A command on this computer, on the bus of a run: it says something to the processes, and hears their answers."""

import time
from collections.abc import Iterator

import zmq

from terrafix.messages import Message
from terrafix.processes import OPERATOR
from terrafix.runtime.bus import Publisher, Subscriber
from terrafix.runtime.run_dir import RunDir

LOOK_MS = 20


class Operator:
    """A context manager; one at a time on a run."""

    def __init__(self, run_dir: RunDir, *, answers: type[Message], answered_by: str) -> None:
        """``answers``: what is heard, of the process ``answered_by``."""
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._publisher = Publisher(self._context, run_dir.address(OPERATOR))
        self._subscriber = Subscriber(self._context, [run_dir.address(answered_by)], (answers,))

    def __enter__(self) -> "Operator":
        return self

    def __exit__(self, *_: object) -> None:
        self._subscriber.close()
        self._publisher.close()
        self._context.term()

    def is_heard(self, kind: type[Message], by: int, wait_s: float) -> bool:
        """Waits until so many processes listen to this kind of message."""
        until = time.monotonic() + wait_s
        while self._publisher.subscriptions(kind) < by and time.monotonic() < until:
            self._publisher.socket.poll(LOOK_MS)
            self._publisher.serve()
        return self._publisher.subscriptions(kind) >= by

    def say(self, message: Message) -> None:
        self._publisher.say(message)

    def answers(self, wait_s: float) -> Iterator[Message]:
        """What is answered within so long, as it comes."""
        until = time.monotonic() + wait_s
        while time.monotonic() < until:
            self._subscriber.socket.poll(LOOK_MS)
            yield from self._subscriber.receive()
