"""A transport in memory for the link's edge, and MAVLink packets of an autopilot."""

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix import messages as m
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


def packed(message: Any, mav: mavlink.MAVLink) -> bytes:
    packet = bytes(message.pack(mav))
    mav.seq = (mav.seq + 1) % 256
    return packet


def heartbeat(autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> Any:
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)


def attitude(boot_ms: int, yaw: float = 1.0) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, yaw, 0, 0, 0)


def states(messages: Iterable[m.Message]) -> list[m.VehicleState]:
    return [x for x in messages if isinstance(x, m.VehicleState)]
