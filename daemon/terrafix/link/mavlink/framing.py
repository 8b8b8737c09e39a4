"""MAVLink packets out of a byte stream. Only packets with a valid checksum are returned, and a damaged packet does not
hide valid packets behind it.

pymavlink's parser trusts the length byte of a damaged packet and drops up to 280 bytes together with the packets in
them. It also returns messages of unknown type, whose checksum cannot be verified. Here a candidate that fails skips one
byte. Framing as in the MAVLink serialization guide (mavlink.io/en/guide/serialization.html)."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

V1, V2 = mavlink.PROTOCOL_MARKER_V1, mavlink.PROTOCOL_MARKER_V2
SIGNED_FLAG = mavlink.MAVLINK_IFLAG_SIGNED
HEADER_BYTES = {V1: 6, V2: 10}  # with the marker [spec: MAVLink serialization guide]
CHECKSUM_BYTES, SIGNATURE_BYTES = 2, mavlink.MAVLINK_SIGNATURE_BLOCK_LEN  # [spec: MAVLink serialization guide]


class Framer:
    """Splits one byte stream into packets. ``skipped``: number of bytes outside of valid packets."""

    def __init__(self) -> None:
        self._incomplete = b""
        self._decoder = mavlink.MAVLink(None)  # has no key: signing.py checks signatures
        self.skipped = 0
        self.received_bytes = 0

    def packets(self, data: bytes) -> Iterator[Any]:
        """-> decoded messages, in order. An incomplete packet (at most 280 bytes) is buffered for the next call."""
        self.received_bytes += len(data)
        data = self._incomplete + data
        offset = 0
        while True:
            start = _next_marker(data, offset)
            self.skipped += start - offset
            offset = start
            length = packet_length(data, offset)
            if length is None or offset + length > len(data):
                break
            message = self._decode(data[offset : offset + length]) if length else None
            if message is None:
                self.skipped += 1
                offset += 1
            else:
                yield message
                offset += length
        self._incomplete = data[offset:]

    def reset(self) -> None:
        """Drops the buffered bytes: the next byte belongs to another stream."""
        self._incomplete = b""

    def _decode(self, packet: bytes) -> Any | None:
        if _message_id(packet) not in mavlink.mavlink_map:
            return None  # the checksum of an unknown type cannot be verified; also rejects most garbage early
        try:
            return self._decoder.decode(bytearray(packet))
        except mavlink.MAVError:
            return None


def packet_length(data: bytes, offset: int) -> int | None:
    """-> length in bytes of the packet whose marker is at ``offset``; 0: no valid packet starts there; None: more bytes
    are needed."""
    if len(data) - offset < 3:
        return None
    if data[offset] == V1:
        return HEADER_BYTES[V1] + data[offset + 1] + CHECKSUM_BYTES
    flags = data[offset + 2]
    if flags & ~SIGNED_FLAG:  # the guide: discard packets whose incompatibility flags are not understood
        return 0
    return HEADER_BYTES[V2] + data[offset + 1] + CHECKSUM_BYTES + (SIGNATURE_BYTES if flags & SIGNED_FLAG else 0)


def _message_id(packet: bytes) -> int:
    return packet[5] if packet[0] == V1 else int.from_bytes(packet[7:10], "little")


def _next_marker(data: bytes, offset: int) -> int:
    places = [p for p in (data.find(V1, offset), data.find(V2, offset)) if p >= 0]
    return min(places, default=len(data))
