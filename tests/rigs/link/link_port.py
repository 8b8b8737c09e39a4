"""Real sockets on loopback for the link's tests: the listening port of an edge, and senders of MAVLink packets."""

import socket
import time
from types import TracebackType
from typing import Any, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from link_wire import heartbeat, packed
from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.edge import MavlinkEdge, open_edge

ARRIVES_S = 0.005  # time for delivery over loopback


class Speaker:
    """One sender of MAVLink packets: a system and component with its own socket."""

    def __init__(self, sysid: int, compid: int = 1, *, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.address: tuple[str, int] = self.socket.getsockname()
        self.mav = mavlink.MAVLink(None, srcSystem=sysid, srcComponent=compid)
        self._parser = mavlink.MAVLink(None)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.socket.close()

    def send(self, to: tuple[str, int], *messages: Any) -> None:
        for message in messages:
            self.socket.sendto(packed(message, self.mav), to)

    def received(self, kind: str = "") -> list[Any]:
        """-> messages received since the last call; only those of type ``kind``, if given."""
        time.sleep(ARRIVES_S)
        found = []
        while True:
            try:
                found.append(self._parser.decode(bytearray(self.socket.recv(4096))))
            except BlockingIOError:
                return [x for x in found if not kind or x.get_type() == kind]

    def kinds(self) -> set[str]:
        return {x.get_type() for x in self.received()}


def free_port() -> int:
    with Speaker(1) as speaker:
        return speaker.address[1]


class Port:
    """A listening edge. ``published``: all messages of its polls."""

    def __init__(self, edge: MavlinkEdge, address: tuple[str, int]) -> None:
        self.edge, self.address = edge, address
        self.published: list[m.Message] = []

    def receives(self, now_ns: int, speaker: Speaker, *messages: Any) -> list[m.Message]:
        """Sends the messages to the edge, and polls it."""
        speaker.send(self.address, *messages)
        return self.poll(now_ns)

    def poll(self, now_ns: int) -> list[m.Message]:
        time.sleep(ARRIVES_S)
        published = list(self.edge.poll(now_ns))
        self.published += published
        return published

    def detail(self) -> str:
        """-> detail of the newest LinkStatus."""
        return [x for x in self.published if isinstance(x, m.LinkStatus)][-1].detail

    def texts(self) -> list[str]:
        return [x.text for x in self.published if isinstance(x, m.StatusText)]


def listening(**changes: Any) -> Port:
    port = free_port()
    return Port(open_edge(LinkSection(device=f"udpin:127.0.0.1:{port}", **changes)), ("127.0.0.1", port))


def armed() -> Any:
    beat = heartbeat()
    beat.base_mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    return beat


def station_heartbeat() -> Any:
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3)
