"""A wire in memory for the link's edge, and the packets of an autopilot."""

from collections.abc import Iterable
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from terrafix import messages as m
from terrafix.link.mavlink.transport import Address, Chunk


class MemoryWire:
    """A Transport: ``arrive`` is what the other side sends, ``sent`` what we sent."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self._coming: list[bytes] = []

    def arrive(self, *chunks: bytes) -> None:
        self._coming += chunks

    def read(self) -> list[Chunk]:
        coming, self._coming = self._coming, []
        return [(chunk, None) for chunk in coming]

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        self.sent.append(packet)
        return True

    def close(self) -> None:
        pass

    def take(self, kind: str = "") -> list[Any]:
        """What we sent since the last call, decoded."""
        sent, self.sent = self.sent, []
        ear = mavlink.MAVLink(None)
        heard = [ear.decode(bytearray(packet)) for packet in sent]
        return [x for x in heard if not kind or x.get_type() == kind]


def packed(message: Any, mav: mavlink.MAVLink) -> bytes:
    packet = bytes(message.pack(mav))
    mav.seq = (mav.seq + 1) % 256
    return packet


def heartbeat(autopilot: int = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA) -> Any:
    return mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_QUADROTOR, autopilot, 0, 0, mavlink.MAV_STATE_ACTIVE, 3)


def attitude(boot_ms: int, yaw: float = 1.0) -> Any:
    return mavlink.MAVLink_attitude_message(boot_ms, 0.1, 0.2, yaw, 0, 0, 0)


def states(said: Iterable[m.Message]) -> list[m.VehicleState]:
    return [x for x in said if isinstance(x, m.VehicleState)]
