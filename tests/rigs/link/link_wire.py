"""A transport in memory, the link's edge on it, and MAVLink packets of an autopilot."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix import messages as m
from terrafix.core.config import LinkSection
from terrafix.link.autopilot.checkpoint import LinkCheckpointWriter
from terrafix.link.edge import MavlinkEdge
from terrafix.link.gnss.previous_source import PreviousSourceFile
from terrafix.link.mavlink.transport import Address, Chunk


class MemoryWire:
    """A Transport. ``arrive``: adds received bytes; ``sent``: the packets that the edge has sent."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self._received: list[bytes] = []

    def arrive(self, *chunks: bytes) -> None:
        self._received += chunks

    def read(self) -> list[Chunk]:
        received, self._received = self._received, []
        return [(chunk, None) for chunk in received]

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        self.sent.append(packet)
        return True

    def close(self) -> None:
        pass

    def take(self, kind: str = "") -> list[Any]:
        """-> messages sent since the last call, decoded; only those of type ``kind``, if given."""
        sent, self.sent = self.sent, []
        parser = mavlink.MAVLink(None)
        messages = [parser.decode(bytearray(packet)) for packet in sent]
        return [x for x in messages if not kind or x.get_type() == kind]


class PolledEdge:
    """An edge of the link. ``published``: all messages of its polls."""

    def __init__(self, edge: MavlinkEdge) -> None:
        self.edge = edge
        self.published: list[m.Message] = []

    def poll(self, now_ns: int) -> list[m.Message]:
        published = list(self.edge.poll(now_ns))
        self.published += published
        return published

    def status(self) -> m.LinkStatus:
        """-> the newest LinkStatus."""
        return [x for x in self.published if isinstance(x, m.LinkStatus)][-1]

    def texts(self) -> list[str]:
        return [x.text for x in self.published if isinstance(x, m.StatusText)]


class WiredEdge(PolledEdge):
    """The edge on a wire in memory. ``config``: keys of LinkSection."""

    def __init__(
        self,
        *,
        checkpoint: Path | None = None,
        previous_source: PreviousSourceFile | None = None,
        unix_ns: int = 0,
        **config: Any,
    ) -> None:
        self.wire = MemoryWire()
        self._senders: dict[tuple[int, int], mavlink.MAVLink] = {}
        writer = LinkCheckpointWriter(checkpoint)
        files: Any = {"checkpoint_writer": writer, "previous_source": previous_source}
        super().__init__(MavlinkEdge(LinkSection(**config), self.wire, lambda: unix_ns, **files))

    def receives(self, now_ns: int, *messages: Any, sysid: int = 7, compid: int = 1) -> list[m.Message]:
        """-> what the edge publishes when these messages of a system and component have arrived."""
        sender = self._senders.setdefault((sysid, compid), mavlink.MAVLink(None, sysid, compid))
        self.wire.arrive(*(packed(message, sender) for message in messages))
        return self.poll(now_ns)


def packed(message: Any, mav: mavlink.MAVLink) -> bytes:
    packet = bytes(message.pack(mav))
    mav.seq = (mav.seq + 1) % 256
    return packet


def decoded(message: Any, sysid: int = 1, compid: int = 1) -> Any:
    """-> the message after encoding and decoding."""
    return mavlink.MAVLink(None).decode(bytearray(packed(message, mavlink.MAVLink(None, sysid, compid))))


def heartbeat(
    autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
    *,
    mode: int = 0,
    kind: int = mavlink.MAV_TYPE_QUADROTOR,
) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, mode, 0, mavlink.MAV_STATE_ACTIVE, 3)


def armed() -> Any:
    return heartbeat(mode=mavlink.MAV_MODE_FLAG_SAFETY_ARMED)


def station_heartbeat() -> Any:
    return heartbeat(mavlink.MAV_AUTOPILOT_INVALID, kind=mavlink.MAV_TYPE_GCS)


def attitude(boot_ms: int, yaw: float = 1.0) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, yaw, 0, 0, 0)


def states(messages: Iterable[m.Message]) -> list[m.VehicleState]:
    return [x for x in messages if isinstance(x, m.VehicleState)]
