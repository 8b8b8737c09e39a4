"""Messages between processes: pyzmq publish and subscribe over ipc, drops counted, nobody waits.

Every process publishes on an endpoint of its own and connects to those who say what it hears: no broker whose death
would silence all. Sockets reconnect by themselves, so either side may be killed and started again.

A message travels as (topic, header, body): topic = type name and "|" (zmq matches prefixes), header = a number of
this life of the publisher and one that counts the messages of this topic. Gaps in the count are losses.

*Retained* messages: a subscriber that comes late (a restarted process) gets them again from their publisher, which
sees every subscription (XPUB). The others see them twice and know it by the count."""

import os
import struct
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import zmq

from terrafix.core import codec
from terrafix.core.clock import now_ns
from terrafix.messages import Message, Origin, ProcessEvent, SourceEnded

QUEUE_LENGTH = 1000  # messages per connection and side; then the newest are lost, and counted by the reader
RECONNECT_MS = 20  # how soon a restarted publisher is found again
LINGER_MS = 200  # last words, at most this long
BURST = 500  # messages taken from the socket at once, so that a flood cannot keep a process from its ticks
HEADER = struct.Struct(">QQ")  # life of the publisher, count in the topic

ALWAYS_NS = 2**63


class Retention(NamedTuple):
    last: int  # how many
    max_age_ns: int


# What late comers get again. Events of processes: what happened while the recorder was started (again), but not the
# old deaths, which would be news to a link that has just been restarted.
RETAINED: dict[type[Message], Retention] = {
    Origin: Retention(1, ALWAYS_NS),
    SourceEnded: Retention(1, ALWAYS_NS),
    ProcessEvent: Retention(100, 10_000_000_000),
}


def topic(kind: type[Message]) -> bytes:
    return kind.__name__.encode() + b"|"


class Publisher:
    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], address: str, clock: Callable[[], int] = now_ns
    ) -> None:
        self._clock = clock
        self.socket = context.socket(zmq.XPUB)
        # A subscription counts from when ``serve`` has seen it, and not from some moment inside of a send: who needs
        # what is retained would hear the message that is just being sent before it.
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.SNDHWM, QUEUE_LENGTH)
        self.socket.setsockopt(zmq.LINGER, LINGER_MS)
        self.socket.bind(address)  # replaces the socket file of a killed predecessor
        self._life = int.from_bytes(os.urandom(8), "big")
        self._count: Counter[bytes] = Counter()
        self._subscriptions: Counter[bytes] = Counter()
        self._retained: dict[bytes, deque[tuple[int, list[bytes]]]] = {
            topic(kind): deque(maxlen=retention.last) for kind, retention in RETAINED.items()
        }
        self._max_age_ns = {topic(kind): retention.max_age_ns for kind, retention in RETAINED.items()}

    def say(self, message: Message) -> None:
        self.serve()
        name = topic(type(message))
        self._count[name] += 1
        parts = [name, HEADER.pack(self._life, self._count[name]), codec.encode(message)]
        if name in self._retained:
            self._retained[name].append((self._clock(), parts))
        self.socket.send_multipart(parts)

    def serve(self) -> None:
        """Gives new subscribers what is retained; call it regularly."""
        while self.socket.poll(0):
            request = self.socket.recv()
            name = request[1:]
            wanted = request[:1] == b"\x01"
            self.socket.setsockopt(zmq.SUBSCRIBE if wanted else zmq.UNSUBSCRIBE, name)
            if wanted:
                self._subscriptions[name] += 1
                for said_ns, parts in self._retained.get(name, ()):
                    if self._clock() - said_ns <= self._max_age_ns[name]:
                        self.socket.send_multipart(parts)

    def subscriptions(self, kind: type[Message]) -> int:
        """How many subscriptions to this type have come so far."""
        return self._subscriptions[topic(kind)]

    def close(self) -> None:
        self.socket.close()


class Subscriber:
    """``lost`` counts messages that were said and did not arrive, by type name."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], addresses: Iterable[str], kinds: Iterable[type[Message]]
    ) -> None:
        self.socket = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, QUEUE_LENGTH)
        self.socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        for kind in kinds:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic(kind))
        for address in addresses:
            self.socket.connect(address)
        self._last: defaultdict[bytes, dict[int, int]] = defaultdict(dict)  # topic -> life -> count
        self.lost: Counter[str] = Counter()

    def receive(self) -> Iterator[Message]:
        """What has arrived, at most BURST, without waiting."""
        for _ in range(BURST):
            try:
                name, header, body = self.socket.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            if self._is_new(name, header):
                yield codec.decode(body)

    def _is_new(self, name: bytes, header: bytes) -> bool:
        life, count = HEADER.unpack(header)
        last = self._last[name].get(life)
        if last is not None and count <= last:
            return False  # retained, said again for somebody else
        if last is not None and count > last + 1:
            self.lost[name[:-1].decode()] += count - last - 1
        self._last[name][life] = count
        return True

    def close(self) -> None:
        self.socket.close(linger=0)
