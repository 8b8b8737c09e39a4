"""In-memory transport between the companion's MAVLink edge and an autopilot in the same process."""

from terrafix.link.mavlink.transport import Address, Chunk


class Loopback:
    """The companion's ``Transport`` (link/mavlink/transport.py) on one side, byte streams of the autopilot on the
    other.
    """

    def __init__(self) -> None:
        self._to_companion: list[bytes] = []
        self._to_autopilot: list[bytes] = []

    def read(self) -> list[Chunk]:
        packets, self._to_companion = self._to_companion, []
        return [(packet, None) for packet in packets]

    def write(self, packet: bytes, to: Address | None = None) -> bool:
        self._to_autopilot.append(packet)
        return True

    def close(self) -> None:
        """No resource is open."""

    def to_companion(self, packets: bytes) -> None:
        """Queues bytes from the autopilot for the companion."""
        if packets:
            self._to_companion.append(packets)

    def take(self) -> bytes:
        """Returns the bytes for the autopilot since the last call."""
        packets, self._to_autopilot = self._to_autopilot, []
        return b"".join(packets)
