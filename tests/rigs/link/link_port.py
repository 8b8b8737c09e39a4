"""Real sockets on loopback for the link's tests: the listening port of an edge, and senders of MAVLink packets."""

import socket
import time
from types import TracebackType
from typing import Any, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import PolledEdge, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge, open_edge

ARRIVES_S = 0.005  # time for delivery over loopback


class Speaker:
    """One sender of MAVLink packets: a system and component with a socket. ``peer``: who sent it the last packet."""

    def __init__(self, sysid: int, compid: int = 1, *, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.address: tuple[str, int] = self.socket.getsockname()
        self.mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self.peer = self.address
        self._parser = mavlink.MAVLink(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.socket.close()

    def send(self, *messages: Any, to: tuple[str, int] | None = None) -> None:
        for message in messages:
            self.socket.sendto(packed(message, self.mav), to or self.peer)

    def received(self, kind: str = "") -> list[Any]:
        """-> messages received since the last call; only those of type ``kind``, if given."""
        time.sleep(ARRIVES_S)
        found = []
        while True:
            try:
                packet, self.peer = self.socket.recvfrom(4096)
                found.append(self._parser.decode(bytearray(packet)))
            except BlockingIOError:
                return [x for x in found if not kind or x.get_type() == kind]

    def kinds(self) -> set[str]:
        return kinds(self.received())


def kinds(messages: list[Any]) -> set[str]:
    return {x.get_type() for x in messages}


def free_port() -> int:
    with Speaker(1) as speaker:
        return speaker.address[1]


class Port(PolledEdge):
    """A listening edge."""

    def __init__(self, edge: MavlinkEdge, address: tuple[str, int]) -> None:
        super().__init__(edge)
        self.address = address

    def receives(self, now_ns: int, speaker: Speaker, *messages: Any) -> list[m.Message]:
        """Sends the messages to the edge, and polls it."""
        speaker.send(*messages, to=self.address)
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[m.Message]:
        time.sleep(ARRIVES_S)
        return super().poll(now_ns)


def listening(**changes: Any) -> Port:
    port = free_port()
    return Port(open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}", **changes)), ("127.0.0.1", port))
