"""Publish/subscribe messaging between processes: pyzmq over ipc, non-blocking, with counted losses.

Every process publishes on its own endpoint and connects to the publishers of the messages it subscribes to. There is
no broker, which would be a single point of failure. Sockets reconnect automatically, so that either side may be killed
and restarted.

A message is sent as (topic, header, body). Topic: type name and "|", because zmq matches prefixes. Header: a session id
of the publisher, random for each start of the process, and a sequence number per topic. Gaps in the sequence numbers
are losses.

*Retained* messages are sent again to a late subscriber (a restarted process) by their publisher, which receives every
subscription (XPUB). Other subscribers receive them twice and discard them by their sequence number."""

import os
import struct
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import zmq

from terrafix.core import codec
from terrafix.core.clock import now_ns
from terrafix.messages import GpsInput, InputOrder, Message, Origin, ProcessEvent, SourceEnded, SourceFacts

# messages per connection and side; beyond it the newest are lost, and counted by the subscriber
BUS_QUEUE_LENGTH = 1000
RECONNECT_MS = 20  # interval of reconnection attempts to a restarted publisher
LINGER_MS = 200  # time limit for sending queued messages at exit
RECEIVE_BURST = 500  # most messages received in one call, so that a burst cannot delay the ticks of a process
BUS_HEADER = struct.Struct(">QQ")  # session id of the publisher, sequence number in the topic

NO_EXPIRY_NS = 2**63


class Retention(NamedTuple):
    last: int  # number of messages
    max_age_ns: int
    until_recorded: bool = False  # only those that are published before the recorder (InputOrder) has subscribed


# Messages that are sent again to late subscribers. ProcessEvent: the age limit covers the events during a (re)start of
# the recorder, but excludes old deaths, which a restarted link would report as new. GpsInput: what a restarted link
# sends to the autopilot is recorded although the recorder connects late, on a computer with too much to do.
RETAINED: dict[type[Message], Retention] = {
    Origin: Retention(1, NO_EXPIRY_NS),
    SourceFacts: Retention(1, NO_EXPIRY_NS),
    SourceEnded: Retention(1, NO_EXPIRY_NS),
    ProcessEvent: Retention(100, 10_000_000_000),
    GpsInput: Retention(100, 10_000_000_000, until_recorded=True),
}


def topic(kind: type[Message]) -> bytes:
    return kind.__name__.encode() + b"|"


class Publisher:
    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], address: str, clock: Callable[[], int] = now_ns
    ) -> None:
        self._clock = clock
        self.socket = context.socket(zmq.XPUB)
        # A subscription becomes active in ``serve``. Otherwise it could become active during a send, and the subscriber
        # would receive the message being sent before the retained ones.
        self.socket.setsockopt(zmq.XPUB_MANUAL, 1)
        self.socket.setsockopt(zmq.SNDHWM, BUS_QUEUE_LENGTH)
        self.socket.setsockopt(zmq.LINGER, LINGER_MS)
        self.socket.bind(address)  # replaces the socket file of a killed process
        self._session_id = int.from_bytes(os.urandom(8), "big")
        self._sequence: Counter[bytes] = Counter()
        self._subscriptions: Counter[bytes] = Counter()
        self._retained: dict[bytes, deque[tuple[int, list[bytes]]]] = {
            topic(kind): deque(maxlen=retention.last) for kind, retention in RETAINED.items()
        }
        self._max_age_ns = {topic(kind): retention.max_age_ns for kind, retention in RETAINED.items()}

    def publish(self, message: Message) -> None:
        """Sends ``message`` to all subscribers of its type."""
        self.serve()
        name = topic(type(message))
        self._sequence[name] += 1
        parts = [name, BUS_HEADER.pack(self._session_id, self._sequence[name]), codec.encode(message)]
        retention = RETAINED.get(type(message))
        if retention is not None and not (retention.until_recorded and self.subscriptions(InputOrder)):
            self._retained[name].append((self._clock(), parts))
        self.socket.send_multipart(parts)

    def serve(self) -> None:
        """Activates new subscriptions and sends them the retained messages. Must be called regularly."""
        while self.socket.poll(0):
            request = self.socket.recv()
            name = request[1:]
            is_subscription = request[:1] == b"\x01"
            self.socket.setsockopt(zmq.SUBSCRIBE if is_subscription else zmq.UNSUBSCRIBE, name)
            if is_subscription:
                self._subscriptions[name] += 1
                for published_ns, parts in self._retained.get(name, ()):
                    if self._clock() - published_ns <= self._max_age_ns[name]:
                        self.socket.send_multipart(parts)

    def subscriptions(self, kind: type[Message]) -> int:
        """Number of subscriptions to this type received so far."""
        return self._subscriptions[topic(kind)]

    def close(self) -> None:
        self.socket.close()


class Subscriber:
    """``lost`` counts messages that were published and did not arrive, by type name."""

    def __init__(
        self, context: zmq.Context[zmq.Socket[bytes]], addresses: Iterable[str], kinds: Iterable[type[Message]]
    ) -> None:
        self.socket = context.socket(zmq.SUB)
        self.socket.setsockopt(zmq.RCVHWM, BUS_QUEUE_LENGTH)
        self.socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_MS)
        for kind in kinds:
            self.socket.setsockopt(zmq.SUBSCRIBE, topic(kind))
        for address in addresses:
            self.socket.connect(address)
        self._last: defaultdict[bytes, dict[int, int]] = defaultdict(dict)  # topic -> session id -> sequence number
        self.lost: Counter[str] = Counter()

    def receive(self) -> Iterator[Message]:
        """The messages that have arrived, at most RECEIVE_BURST, without blocking."""
        for _ in range(RECEIVE_BURST):
            try:
                name, header, body = self.socket.recv_multipart(zmq.DONTWAIT)
            except zmq.Again:
                return
            if self._is_new(name, header):
                yield codec.decode(body)

    def _is_new(self, name: bytes, header: bytes) -> bool:
        session_id, sequence = BUS_HEADER.unpack(header)
        last = self._last[name].get(session_id)
        if last is not None and sequence <= last:
            return False  # a retained message, sent again for another subscriber
        if last is not None and sequence > last + 1:
            self.lost[name[:-1].decode()] += sequence - last - 1
        self._last[name][session_id] = sequence
        return True

    def close(self) -> None:
        self.socket.close(linger=0)
